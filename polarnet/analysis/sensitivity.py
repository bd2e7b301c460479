"""Sensitivity to the sensor and the motion: change one setting at a time and score the methods."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from polarnet.analysis.resimulate import resimulated
from polarnet.benchmark.rows import Context, predictions_of
from polarnet.benchmark.score import FrameScore, mean_scores, score_sequence
from polarnet.simulation.camera import Camera
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import SynthesizeConfig
from polarnet.storage.scenes import SceneStore
from polarnet.terminal.progress import ProgressBar

CHANNEL_SIGNS = (1, -1, -1, 1)
"""Signs of the threshold error behind 0, 45, 90 and 135 degrees, opposite within each pair that gives S1 or S2."""

SETTINGS: Mapping[str, Sequence[float]] = {
    "threshold_mismatch": (0.0, 0.03, 0.06, 0.12),
    "noise_rate_hz": (0.0, 0.1, 1.0, 5.0),
    "speed": (0.25, 0.5, 1.0, 2.0, 4.0),
    "channel_error": (0.0, 0.05, 0.1, 0.2, 0.4),
}
"""Values of each setting.

- threshold_mismatch: standard deviation of the contrast threshold between pixels, in natural-log intensity.
- noise_rate_hz: shot-noise events per pixel and second.
- speed: factor on the configured speed.
- channel_error: relative error of the contrast threshold in each channel, with the signs `CHANNEL_SIGNS`. The
  thresholds of a Prophesee sensor differ by 0.2 to 0.3 over its settings.
"""
SHOWN = ("mse", "psnr", "corr", "skill")


@dataclasses.dataclass(frozen=True)
class Emulation:
    """How scenes are emulated again: the unchanged motion and camera, and the seed of their noise."""

    motion: SynthesizeConfig
    camera: Camera
    seed: int
    threads: int = 1

    def cameras(self, setting: str, value: float, sequence: str) -> list[Camera]:
        """Cameras whose four channels have one setting of the sensor changed; `speed` leaves them unchanged."""
        camera = self.camera.drawn(self.seed, sequence)
        return [dataclasses.replace(camera, sensor=sensor) for sensor in _sensors(setting, value, camera.sensor)]


def _sensors(setting: str, value: float, emulate: EmulatorConfig) -> list[EmulatorConfig]:
    if setting == "threshold_mismatch":
        return [dataclasses.replace(emulate, contrast_threshold_sigma_on=value, contrast_threshold_sigma_off=value)] * 4
    if setting == "noise_rate_hz":
        return [dataclasses.replace(emulate, shot_noise_rate_hz=value)] * 4
    if setting == "channel_error":
        return [
            dataclasses.replace(
                emulate,
                contrast_threshold_on=emulate.contrast_threshold_on * (1 + sign * value),
                contrast_threshold_off=emulate.contrast_threshold_off * (1 + sign * value),
            )
            for sign in CHANNEL_SIGNS
        ]
    if setting == "speed":
        return [emulate] * 4
    raise ValueError(f"expected one of {', '.join(SETTINGS)}, got {setting!r}")


def sensitivity(
    scenes: SceneStore,
    sequences: Sequence[str],
    emulation: Emulation,
    methods: Sequence[str],
    context: Context,
    warmup_windows: int,
    settings: Mapping[str, Sequence[float]] = SETTINGS,
) -> dict[str, list[dict[str, Any]]]:
    """Event rates per pixel and second and mean scores over scenes of each method, for every value of each setting.

    Sequences are emulated again from their stored scenes with their original noise. A sequence is left out at speeds
    that its picture has no room for; `sequences` in each entry counts the remaining ones.
    """
    table: dict[str, list[dict[str, Any]]] = {}
    points = [(setting, value) for setting, values in settings.items() for value in values]
    for setting, value in ProgressBar(points, "sensitivity", unit="setting"):
        rows: list[FrameScore] = []
        rates: list[float] = []
        left_out: list[str] = []
        for sequence in sequences:
            speed = value if setting == "speed" else 1.0
            try:
                test = resimulated(
                    scenes, sequence, emulation.motion, emulation.cameras(setting, value, sequence), emulation.seed,
                    speed, emulation.threads,
                )  # fmt: skip
            except ValueError as error:
                if setting != "speed":
                    raise
                left_out.append(f"{sequence}: {error}")
                continue
            predictions = predictions_of(methods, test, context)
            rows += score_sequence(test, predictions, warmup_windows, None, context.device)
            pixels = test.events[0].height * test.events[0].width
            seconds = (int(test.t_us[-1]) - int(test.t_us[0])) / 1e6
            rates.append(sum(map(len, test.events)) / (4 * pixels * seconds))
        if rows:
            entry = {
                "value": value,
                "sequences": len(rates),
                "left_out": left_out,
                "events_per_pixel_second": float(np.mean(rates)),
                "scores": mean_scores(rows, SHOWN),
            }
            table.setdefault(setting, []).append(entry)
    return table
