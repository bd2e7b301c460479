"""How true the simulated camera is: python -m studies.camera [--write]

Each defect that an audit found is checked anew on its smallest input, and a DoFP sensor is calibrated from its own
events. `--write` puts the figures into docs/results/camera.json.
"""

import itertools
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from polarnet.clips.video import simulate_video
from polarnet.config.tree import load
from polarnet.events.rotation import Rotation
from polarnet.events.stream import Events, select
from polarnet.methods.rotating_polarizer import fit_half_turn
from polarnet.pictures.polarimetry import group_by_measurement, white_level
from polarnet.simulation.camera import Camera, Grid, pixel_analyzers
from polarnet.simulation.emulator import EmulatorConfig, emulate
from polarnet.simulation.motion import Pose, render_poses, resting_trajectory
from polarnet.simulation.moving_sensor import behind_polarizers, emulate_motion, render_times_us
from polarnet.simulation.pixels.light import FULL_SCALE, KNEE
from polarnet.simulation.presets import POLARIZERS, SENSORS
from polarnet.simulation.rotating import RotatingConfig, emulate_rotating
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization
from polarnet.simulation.sets import kind_of
from polarnet.simulation.truth import valid_frames
from polarnet.simulation.upsampling import StokesFrame, upsampled
from polarnet.stokes import aolp, dolp
from studies.study import ROOT, arguments_of, command_line, machine_record, write_section

SIZE = (12, 16)  # rows and columns of the calibrated sensor
STEP = 0.01  # contrast thresholds of its pixels, natural-log intensity
LAMP_DOLP = 0.6  # keeps the light behind every pixel above the knee of the response
LINEAR_RESPONSE = 2.5  # the response is proportional to light up to ln 20 = 3.0
ABOVE_KNEE = 1 / 3  # share of its light from which the lamp is above the knee behind every polarizer
HALF_TURN_US, FRAMES = 4_000_000, 360


def quiet(step: float) -> EmulatorConfig:
    """A sensor with equal thresholds and neither noise nor bandwidth."""
    return replace(
        SENSORS["clean"], contrast_threshold_on=step, contrast_threshold_off=step, contrast_threshold_sigma_on=0.0,
        contrast_threshold_sigma_off=0.0,
    )  # fmt: skip


def lamp(s0: float, degree: float, angle: float, size: tuple[int, int] = SIZE) -> PolarizationScene:
    """Light that is the same all over the sensor."""
    return scene_from_polarization(*(torch.full(size, value) for value in (s0, degree, angle % math.pi)))


def calibrated_analyzers(camera: Camera, seed: int) -> Float64[Tensor, "4 3 h w"]:
    """Analyzer of every pixel of a DoFP sensor, from the events of two recordings of a uniform lamp.

    First the lamp is unpolarized and rises from dark to white, then falls. Above the knee, the light at a pixel's
    events gives its thresholds; below, where the response is proportional to light, its a0. Then the lamp's
    polarization turns: `fit_half_turn` gives (a1, a2) / a0.
    """
    rate_hz, base = 0.5e6 / HALF_TURN_US, load(ROOT).methods.rotating_polarizer
    t_us = np.linspace(0, 2 * HALF_TURN_US, 2 * FRAMES + 1).round().astype(int).tolist()
    swelling = [lamp(min(k, 2 * FRAMES - k) / FRAMES, 0.0, 0.0) for k in range(2 * FRAMES + 1)]
    turning = [lamp(1.0, LAMP_DOLP, math.pi * t / HALF_TURN_US) for t in t_us[: FRAMES + 1]]
    rotation = Rotation(np.array([0.0, 1.0]) / rate_hz * 1e6, np.array([0.0, 2 * math.pi]))
    swollen = simulate_video(swelling, t_us, camera, seed).events
    turned = simulate_video(turning, t_us[: FRAMES + 1], camera, seed).events
    analyzers = torch.zeros(len(turned), 3, SIZE[0] // 2, SIZE[1] // 2, dtype=torch.float64)
    for channel, place in itertools.product(range(len(turned)), np.ndindex(SIZE[0] // 2, SIZE[1] // 2)):
        lit, turns = (of_pixel(events[channel], *place) for events in (swollen, turned))
        t, rises = lit.t.numpy(), lit.p.numpy() > 0
        shares = 1 - np.abs(t / HALF_TURN_US - 1)  # of the lamp's light
        on, off = (
            abs(math.log(bright[-1] / bright[0])) / (len(bright) - 1)
            for bright in (shares[side & (shares > ABOVE_KNEE)] for side in (rises, ~rises))
        )
        dim = shares[rises][: int(LINEAR_RESPONSE / on)]
        a0 = on * (len(dim) - 1) / (dim[-1] - dim[0]) * KNEE / math.log(KNEE) / FULL_SCALE
        assert a0 * ABOVE_KNEE * FULL_SCALE > KNEE
        config = replace(
            base, threshold_on=on, threshold_off=off, cutoff_hz=camera.sensor.cutoff_hz, level_dn=a0 * FULL_SCALE,
            ridge=1e-9,
        )  # fmt: skip
        degree, angle, _ = (one[place].item() for one in fit_half_turn(turns, rotation, HALF_TURN_US, config))
        polarized = a0 * degree / LAMP_DOLP
        analyzer = [a0, polarized * math.cos(2 * angle), polarized * math.sin(2 * angle)]
        analyzers[channel, :, *place] = torch.tensor(analyzer)
    return analyzers


def of_pixel(events: Events, row: int, column: int) -> Events:
    """The events of one pixel."""
    return select(events, (events.y == row) & (events.x == column))


def analyzer_errors(sensor: EmulatorConfig, seed: int = 1) -> Float64[Tensor, "4 3 h w"]:
    """Errors of calibrated analyzers, relative to the a0 of their pixels, for the preset of micropolarizers."""
    camera = Camera(sensor, POLARIZERS["micropolarizers"])
    true = pixel_analyzers(camera.drawn(seed, "video"), *SIZE).double()
    return (calibrated_analyzers(camera, seed) - true) / true[:, :1]


def frames_are_photographs() -> bool:
    """frame_0000 to frame_0139 hold the numbers 0, 45, 90 and 135."""
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, f"frame_{k:04d}.png") for k in range(140)]
        for file in files:
            file.touch()
        return kind_of(Path(folder)) == "photographs" and len(group_by_measurement(files)) == len(files)


def left_aligned_bits_saturate() -> bool:
    """10, 12 and 14 bits at the upper end of 16, over a black level of 37."""
    levels = {bits: np.array([37, 1000, 2**bits - 1], np.uint16).reshape(1, 1, 3) for bits in (10, 12, 14)}
    return all(white_level(one << (16 - bits)) == (2**bits - 1) << (16 - bits) for bits, one in levels.items())


def masks_reach_whole_cells() -> bool:
    """A pixel of the scene that four cells mix with, and one that a cell sees, and its four neighbours by crosstalk."""
    valid = torch.ones(12, 12, dtype=torch.bool)
    valid[5, 5] = False

    def masked(place: float, crosstalk: float) -> int:
        still = replace(resting_trajectory(8, 8), x=place, y=place)  # its first pixel looks at place - 3.5
        return int((~valid_frames(valid, still, [0], Grid(4, 4, 2), crosstalk)).sum())

    return [masked(4.75, 0.0), masked(5.75, 0.0), masked(5.75, 0.1)] == [4, 1, 5]


def polarization_alone_moves() -> bool:
    """AoLP that moves by 8 pixels at constant S0 and DoLP gets interpolated frames."""
    waves = torch.sin(torch.arange(80) / 5.0) + torch.sin(torch.arange(40) / 4.0)[:, None]
    angle = (waves + 2) * (math.pi / 5)
    even = torch.full((40, 64), 0.8)
    scenes = [scene_from_polarization(even, even, angle[:, k : k + 64].contiguous()).stokes for k in (0, 8)]
    return len(list(upsampled([StokesFrame(0, scenes[0]), StokesFrame(16_000, scenes[1])]))) > 8


def aolp_rolls_with_the_picture() -> bool:
    """AoLP 30 degrees, seen by a camera that is rolled clockwise by 20, is at 50."""
    pose = Pose(*(np.array([value]) for value in (10.0, 10.0, math.radians(20), 1.0)))
    seen = aolp(torch.from_numpy(render_poses(lamp(1.0, 1.0, math.pi / 6, (21, 21)), pose, 3, 3)))
    return math.isclose(math.degrees(seen[0, 1, 1]), 50, abs_tol=1e-3)


def an_adaptive_rate_follows_a_rotation() -> bool:
    """Behind a rotating polarizer, `render_rate_hz: null` renders each pixel of motion and each part of a turn."""
    path = replace(resting_trajectory(4, 6), speed_px_s=2000.0)
    path = replace(path, x=600.0, x_sines=(replace(path.x_sines[0], amplitude=500.0, rate=4.0), *path.x_sines[1:]))
    t_us = render_times_us(path, 1_000_000, 4, 6, replace(SENSORS["clean"], render_rate_hz=None), 72.0)
    return bool(np.abs(np.diff(path.pose(t_us * 1e-6).x)).max() < 1.01 and np.diff(t_us).max() <= 1e6 / 72 + 1)


def v2e_sees_eight_bits_behind_a_rotating_polarizer() -> bool:
    """Its events are those of the light rounded to 8 bits."""
    rotating = RotatingConfig(rate_hz=2.0, start_angle_deg=0.0, extinction_ratio=None, frames_per_turn=720)
    camera, rest = Camera(replace(SENSORS["clean"], model="v2e"), key=1), resting_trajectory(*SIZE)
    scene = lamp(0.1, 0.5, 0.0)
    events = emulate_rotating(rotating, camera, scene, rest, 200_000, Grid(*SIZE))
    t_us = render_times_us(rest, 200_000, *SIZE, camera.sensor, 1440.0)
    light = behind_polarizers(scene.stokes.numpy()[:, None].repeat(len(t_us), axis=1), rotating.weights(t_us))
    (rounded,), _ = emulate((light[0, :, None] + 0.5).astype(np.uint8), t_us, camera.sensor, key=1)
    return len(events) > 100 and all(torch.equal(getattr(events, k), getattr(rounded, k)) for k in "txyp")


def dolp_of_nan_is_nan() -> bool:
    """In each Stokes parameter."""
    return bool(dolp(torch.eye(3)[..., None, None].log().nan_to_num(0, 0, math.nan)).isnan().all())


def the_last_key_counts() -> bool:
    """Four sensors with jitter, keyed by 2^64 - 1 and the three keys after it."""
    camera = Camera(quiet(0.2), key=2**64 - 1)
    camera = replace(camera, readout=replace(camera.readout, jitter_us=10.0))
    return len(emulate_motion(camera, lamp(0.5, 0.5, 0.0), resting_trajectory(*SIZE), 1000, SIZE)) == 4


def a_clipped_transmission_is_returned() -> bool:
    """Transmission 1 with a spread of 0.03 has a mean of 0.988, in the analyzers that a simulation returns."""
    camera = Camera(SENSORS["clean"], replace(POLARIZERS["ideal"], transmission_spread=0.03))
    return math.isclose(2 * float(pixel_analyzers(camera, 200, 300)[:, 0].mean()), 0.988, abs_tol=1e-3)


DEFECTS = {
    "numbers of frames taken for angles": frames_are_photographs,
    "white of left-aligned bits": left_aligned_bits_saturate,
    "masks of DoFP cells": masks_reach_whole_cells,
    "motion of polarization alone": polarization_alone_moves,
    "AoLP under roll": aolp_rolls_with_the_picture,
    "adaptive rate behind a rotating polarizer": an_adaptive_rate_follows_a_rotation,
    "8 bits behind a rotating polarizer": v2e_sees_eight_bits_behind_a_rotating_polarizer,
    "DoLP of NaN": dolp_of_nan_is_nan,
    "key of 2^64 - 1": the_last_key_counts,
    "clipped transmission": a_clipped_transmission_is_returned,
}
"""Each defect, and the check that it is mended."""

FROM_V2E = ("default", "clean", "noisy", "random")
"""Sensors of conf/sensor that are no real camera's."""


def figures() -> dict[str, Any]:
    """Checks of the defects, the calibration's error, and the number of presets of real cameras."""
    checks = {name: check() for name, check in DEFECTS.items()}
    exact, noisy = (analyzer_errors(sensor) for sensor in (quiet(STEP), SENSORS["default"]))
    presets = sorted(path.stem for path in (ROOT / "conf" / "sensor").glob("*.yaml") if path.stem not in FROM_V2E)
    return {
        "checks": checks,
        "defects_mended": sum(checks.values()),
        "sensor_presets": len(presets),
        "presets": presets,
        "analyzer_error_max": round(float(exact.abs().max()), 5),
        "analyzer_error_default_sensor": {
            "max": round(float(noisy.abs().max()), 4),
            "rms": round(float(noisy.square().mean().sqrt()), 4),
        },
    }


def main() -> None:
    """Measure, print, and with --write keep the figures."""
    write = arguments_of(command_line(__doc__, "docs/results/camera.json")).write
    record, measured = machine_record(), figures()
    print(measured)
    if write:
        headlines = {key: value for key, value in measured.items() if key not in ("checks", "presets")}
        write_section("camera", "defects", measured["checks"], record, headlines)


if __name__ == "__main__":
    main()
