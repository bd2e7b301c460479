"""A simulated rig (paper, section 4): a scene moves across a CeleX-5 eight times, giving eight files with their truth.

`python -m studies.simulated_rig` calibrates such files of a photograph, with sensor noise and hot pixels, as in the
stage. It draws the pictures of the pages on recordings, and writes docs/results/inspection.json.

The scene drifts from right to left. A bright stripe runs above it, and a dark landmark enters on the stripe from the
right. Each capture starts at a random time before the landmark.
"""

import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Int64, UInt16
from skimage import data

from polarnet import stokes
from polarnet.captures.dot import EVENT_CAPTURES, INTENSITY_CAPTURES, RecordingsConfig, read_event_capture
from polarnet.captures.targets import calibrate_targets
from polarnet.config.tree import load
from polarnet.events.stream import Events, merge, select, shifted, slice_time
from polarnet.recordings.formats.celex5 import HEIGHT, WHITE, WIDTH
from polarnet.recordings.inspection import findings, inspect_recording
from polarnet.recordings.recording import open_recording
from polarnet.recordings.writers import write_hdf5
from polarnet.reports.recordings import draw_calibration, recording_picture
from polarnet.runtime.machine import generator_for, seed_for
from polarnet.simulation.camera import Camera
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import render
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.scene import PolarizationScene, scene_from_rgb
from studies.celex5_writer import write_celex5_bin, write_celex5_pictures
from studies.pictures import few_colours
from studies.simulation_run import Drift
from studies.study import PICTURES, ROOT

STRIPE_S0, LANDMARK_S0 = 0.8, 0.04  # unpolarized
SHORTEST_DELAY_S = 0.08  # from the start of a capture to the landmark
HOT_HZ = (1500.0, 3000.0)
BORDER = 2  # margin of the scene around the area that the sensor sees, in pixels
PICTURE_RATE_HZ = 60.0
FULL_WELL = 20_000.0  # electrons of a white pixel of an intensity capture; sets the shot noise
READ_NOISE = 2.0  # of an intensity image, in steps of 12 bits


class RigConfig(NamedTuple):
    """Motion of the rig and hot pixels of its camera; RecordingsConfig gives sensor, region, crop and size."""

    speed_px_s: float
    """Speed of the image on the sensor, in sensor pixels per second."""
    longest_delay_s: float
    """Maximum time from the random start of a capture to the landmark; more than `SHORTEST_DELAY_S`."""
    duration_s: float
    """Duration of a capture after the landmark."""
    hot_pixels: int
    """Number of hot pixels, the same in all four event captures; each fires a few thousand times a second."""


class RigTruth(NamedTuple):
    """Truth for the eight files of a target."""

    start_us: Mapping[str, int]
    """Time on each capture's own clock at which the mean of the landmark's region falls below the dark level."""
    hot: frozenset[tuple[int, int]]
    """(row, column) of each hot pixel."""
    scene: PolarizationScene
    """Scene that the sensor moves over, including stripe and landmark."""
    path: Drift
    landmark_us: int
    """Time of the landmark on the clock of the motion."""


def write_rig(
    folder: Path,
    picture: PolarizationScene,
    config: RigConfig,
    recordings: RecordingsConfig,
    emulator: EmulatorConfig,
    seed: int,
) -> RigTruth:
    """Write the eight captures of a target into `folder`, and return the truth; seed and folder name decide all chance.

    `picture` is enlarged to the area that the moving sensor sees.
    """
    folder.mkdir(parents=True, exist_ok=True)
    name, (height, width) = folder.name, recordings.sensor
    scene, path = rig_scene(picture, config, recordings)
    landmark_us = _landmark_us(scene, path, recordings)
    total_us = landmark_us + round(config.duration_s * 1e6)
    generator = generator_for(seed, name, "rig")
    captures = (*EVENT_CAPTURES, *INTENSITY_CAPTURES)
    delays_s = generator.uniform(SHORTEST_DELAY_S, config.longest_delay_s, len(captures))
    start_us = {capture: round(delay * 1e6) for capture, delay in zip(captures, delays_s, strict=True)}

    camera = Camera(emulator, key=seed_for(seed, name, "emulate"))
    channels = emulate_motion(camera, scene, path, total_us, (height, width), threads=1)
    places = (generator.integers(0, side, config.hot_pixels).tolist() for side in recordings.sensor)
    hot = frozenset(zip(*places, strict=True))
    for capture, events in zip(EVENT_CAPTURES, channels, strict=True):
        noisy = merge([events, _hot_events(hot, total_us, height, width, generator)])
        begin_us = landmark_us - start_us[capture]
        write_celex5_bin(folder / f"{capture}.bin", shifted(select(noisy, noisy.t >= begin_us), begin_us))
    for polarizer, capture in enumerate(INTENSITY_CAPTURES):
        begin_us = landmark_us - start_us[capture]
        count = int((total_us - begin_us) * 1e-6 * PICTURE_RATE_HZ)
        t_us = np.rint((np.arange(count) + generator.uniform()) * 1e6 / PICTURE_RATE_HZ).astype(np.int64)
        t_us = t_us[t_us + begin_us <= total_us]
        pictures = _pictures(scene, path, t_us + begin_us, polarizer, recordings, generator)
        write_celex5_pictures(folder / f"{capture}.bin", pictures, t_us.tolist())

    return RigTruth(start_us, hot, scene, path, landmark_us)


def rig_scene(
    picture: PolarizationScene, config: RigConfig, recordings: RecordingsConfig
) -> tuple[PolarizationScene, Drift]:
    """Scene that the sensor moves over, including stripe and landmark, and the motion."""
    height, width = recordings.sensor
    before = config.speed_px_s * config.longest_delay_s
    total = BORDER + width + int(before + config.speed_px_s * config.duration_s) + BORDER
    planes = np.ascontiguousarray(picture.stokes.permute(1, 2, 0).numpy())
    scene = cv2.resize(planes, (total, height + 2 * BORDER), interpolation=cv2.INTER_LINEAR).transpose(2, 0, 1).copy()
    stripe = BORDER + recordings.region[0] + BORDER
    scene[:, :stripe] = np.array([STRIPE_S0, 0, 0], np.float32)[:, None, None]
    entry = round(BORDER + width + before)  # the landmark's edge reaches the right border after longest_delay_s
    scene[:, :stripe, entry:] = np.array([LANDMARK_S0, 0, 0], np.float32)[:, None, None]
    path = Drift.at(BORDER + (width - 1) / 2, BORDER + (height - 1) / 2, config.speed_px_s)
    return PolarizationScene(torch.from_numpy(scene)), path


def _landmark_us(scene: PolarizationScene, path: Drift, recordings: RecordingsConfig) -> int:
    """Time on the clock of the motion at which the noiseless mean of the region falls below the dark level."""
    height, width = recordings.region
    profile = scene.stokes[0, BORDER : BORDER + height].double().mean(0).numpy() / 2 * 255
    right = path.x + (recordings.sensor[1] - 1) / 2
    t_us = np.arange(0, int(1e6 * (scene.width - 1 - right) / path.speed_px_s), 10)
    columns = right + path.speed_px_s * t_us * 1e-6
    mean = sum(np.interp(columns - k, np.arange(scene.width), profile) for k in range(width)) / width
    return int(t_us[np.argmax(mean < recordings.dark_level)])


def _pictures(
    scene: PolarizationScene,
    path: Drift,
    t_us: Int64[np.ndarray, " n"],
    polarizer: int,
    recordings: RecordingsConfig,
    generator: np.random.Generator,
) -> Iterator[UInt16[np.ndarray, "800 1280"]]:
    height, width = recordings.sensor
    for t in t_us:
        stokes_frame = render(scene, path, np.array([t * 1e-6]), height, width)[0]
        light = stokes.intensities_from_stokes(stokes_frame)[polarizer].clamp(0, 1).numpy()
        electrons = light * FULL_WELL
        noise = np.hypot(np.sqrt(electrons) * (WHITE / FULL_WELL), READ_NOISE)
        values = light * WHITE + noise * generator.standard_normal(light.shape, dtype=np.float32)
        whole = np.zeros((HEIGHT, WIDTH), np.uint16)
        whole[:height, :width] = np.clip(np.rint(values), 0, WHITE)
        yield whole


def _hot_events(
    hot: frozenset[tuple[int, int]], total_us: int, height: int, width: int, generator: np.random.Generator
) -> Events:
    counts = generator.poisson(generator.uniform(*HOT_HZ, len(hot)) * total_us * 1e-6)
    y, x = generator.permutation(np.repeat(np.array(sorted(hot)).reshape(-1, 2), counts, axis=0)).T
    t = np.sort(generator.integers(0, total_us, len(x)))
    return Events.from_columns(t, x, y, generator.choice([-1, 1], len(x)), height, width)


RIG = RigConfig(speed_px_s=100.0, longest_delay_s=0.35, duration_s=0.55, hot_pixels=5)
CUTOFF_HZ = 3000.0  # of the photoreceptor; a low one adds a delay


def main() -> None:
    """Draw the pictures into docs, and write docs/results/inspection.json."""
    config, name = load(ROOT), "coffee"
    recordings = replace(
        config.recordings, enabled=True, sensor=[200, 320], region=[45, 2], crop=[120, 180], size=[30, 45]
    )
    emulator = replace(config.emulate, model="exact", cutoff_hz=CUTOFF_HZ)
    rgb = torch.from_numpy(data.coffee()).permute(2, 0, 1) / 255
    scene = scene_from_rgb(0.1 + 0.85 * rgb)  # a black pixel has no DoLP that could be measured
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        write_rig(scratch / "raw" / name, scene, RIG, recordings, emulator, seed=1)
        (found,) = calibrate_targets([scratch / "raw" / name], scratch / "calibrated", recordings, {})
        draw_calibration(found, recordings, PICTURES / "recordings_calibration.png")
        first = EVENT_CAPTURES[0]
        events = read_event_capture(scratch / "raw" / name / f"{first}.bin", recordings)
        start_us, capture = found.start_us[first], scratch / "events_0.h5"
        common = shifted(slice_time(events, start_us, start_us + found.duration_us), start_us)
        write_hdf5(capture, common)
        inspection = inspect_recording(open_recording(capture))
    (PICTURES / "recordings_inspect.png").write_bytes(recording_picture(inspection))
    lines = [f"$ polarnet inspect {capture.name}", *findings(inspection), f"picture     {capture.name}.png"]
    (ROOT / "docs" / "results" / "inspection.json").write_text(json.dumps({"text": "\n".join(lines)}, indent=2) + "\n")
    for path in PICTURES.glob("recordings_*.png"):
        path.write_bytes(few_colours(path.read_bytes()))


if __name__ == "__main__":
    main()
