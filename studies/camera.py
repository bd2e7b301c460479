"""How true the simulated camera is: python -m studies.camera [--write]

The test of each defect that an audit found is run, and a DoFP sensor is calibrated from its own events. `--write` puts
the figures into docs/results/camera.json.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from polarnet.clips.video import simulate_video
from polarnet.config.tree import load
from polarnet.events.rotation import Rotation
from polarnet.methods.rotating_polarizer import fit_half_turn
from polarnet.simulation.camera import Camera, pixel_analyzers
from polarnet.simulation.pixels.light import FULL_SCALE, KNEE
from polarnet.simulation.presets import POLARIZERS
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization
from studies.simulation_pictures import QUIET
from studies.study import ROOT, arguments_of, command_line, machine_record, passed, write_section

SIZE = (12, 16)  # rows and columns of the calibrated sensor
STEP = 0.01  # contrast thresholds of its pixels, natural-log intensity
LAMP_DOLP = 0.6  # keeps the light behind every pixel above the knee of the response
HALF_TURN_US, FRAMES = 1_000_000, 360
DEFECTS = (
    "pictures/test_polarimetry.py::test_numbers_that_count_frames_are_no_angles",
    "pictures/test_polarimetry.py::test_bits_that_are_0_below_those_of_the_camera_do_not_raise_its_white",
    "simulation/test_truth.py::test_a_cell_is_valid_unless_its_truth_or_light_changes_with_masked_pixels",
    "simulation/test_video.py::test_texture_of_polarization_alone_moves_too",
    "simulation/test_motion.py::test_a_bar_at_30_degrees_polarized_along_itself_stays_so_while_the_camera_rolls",
    "simulation/test_rotating_light.py"
    "::test_light_is_rendered_as_often_as_the_polarizer_the_sensor_and_the_motion_need",
    "simulation/test_rotating_light.py::test_v2e_sees_eight_bits_of_the_light",
    "test_stokes.py::test_dolp_of_nan_is_nan",
    "simulation/test_sensor_polarizers.py::test_keys_count_modulo_2_to_the_64",
    "simulation/test_sensor_polarizers.py::test_a_spread_at_full_transmission_lowers_its_mean_as_stated",
)
"""The test of each defect, below tests/."""
FROM_V2E = ("default", "clean", "noisy", "random")
"""Sensors of conf/sensor that are no real camera's."""


def lamp(s0: float, degree: float, angle: float) -> PolarizationScene:
    """Light that is the same all over the sensor."""
    return scene_from_polarization(*(torch.full(SIZE, value) for value in (s0, degree, angle % math.pi)))


def calibrated_analyzers(camera: Camera, seed: int) -> Float64[Tensor, "4 3 h w"]:
    """Analyzer of every pixel of a DoFP sensor, from the events of two recordings of a uniform lamp.

    The lamp's polarization turns: `fit_half_turn` gives (a1, a2) / a0 of each pixel. Then it is unpolarized and rises
    from dark to white: the number of events is the response to a0 times the lamp's light at the last of them.
    """
    rate_hz, config = 0.5e6 / HALF_TURN_US, load(ROOT).methods.rotating_polarizer
    config = replace(config, threshold_on=STEP, threshold_off=STEP, cutoff_hz=0.0, ridge=1e-9)
    t_us = np.linspace(0, HALF_TURN_US, FRAMES + 1).round().astype(int).tolist()
    turning = [lamp(1.0, LAMP_DOLP, math.pi * t / HALF_TURN_US) for t in t_us]
    rising = [lamp(k / FRAMES, 0.0, 0.0) for k in range(FRAMES + 1)]
    rotation = Rotation(np.array([0.0, 1.0]) / rate_hz * 1e6, np.array([0.0, 2 * math.pi]))
    analyzers = []
    for turned, risen in zip(
        simulate_video(turning, t_us, camera, seed), simulate_video(rising, t_us, camera, seed), strict=True
    ):
        degree, angle, _ = (one.double() for one in fit_half_turn(turned, rotation, HALF_TURN_US, config))
        place = (risen.y.long() * risen.width + risen.x).numpy()
        last_us = np.zeros(degree.numel())
        last_us[place] = risen.t.numpy()  # the last assignment counts
        response = STEP * np.bincount(place, minlength=degree.numel())
        assert response.min() > math.log(KNEE)
        lit = np.exp(response) / (FULL_SCALE * last_us / HALF_TURN_US)  # light behind the pixel over that of the lamp
        a0 = torch.from_numpy(lit).view(degree.shape)
        polarized = a0 * degree / LAMP_DOLP
        analyzers.append(torch.stack([a0, polarized * torch.cos(2 * angle), polarized * torch.sin(2 * angle)]))
    return torch.stack(analyzers)


def analyzer_error_max(seed: int = 1) -> float:
    """Largest error of a calibrated analyzer, relative to the a0 of its pixel, for the preset of micropolarizers."""
    sensor = replace(QUIET, contrast_threshold_on=STEP, contrast_threshold_off=STEP)
    camera = Camera(sensor, POLARIZERS["micropolarizers"])
    true = pixel_analyzers(camera.drawn(seed, "video"), *SIZE).double()
    return float(((calibrated_analyzers(camera, seed) - true).abs() / true[:, :1]).max())


def main() -> None:
    """Measure, print, and with --write keep the figures."""
    write = arguments_of(command_line(__doc__, "docs/results/camera.json")).write
    record, cases = machine_record(), passed(*(f"tests/{test}" for test in DEFECTS))
    mended = {
        test: min(right for case, right in cases.items() if case.partition("[")[0] == test.partition("::")[2])
        for test in DEFECTS
    }
    cameras = [path for path in (ROOT / "conf" / "sensor").glob("*.yaml") if path.stem not in FROM_V2E]
    totals = {
        "defects_mended": sum(mended.values()),
        "sensor_presets": len(cameras),
        "analyzer_error_max": round(analyzer_error_max(), 5),
    }
    print(mended, totals)
    if write:
        write_section("camera", "defects", mended, record, totals)


if __name__ == "__main__":
    main()
