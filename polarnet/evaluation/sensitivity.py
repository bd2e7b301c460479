"""How recovery bears a sensor or a motion that differs from the one of training: one setting changed at a time."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from polarnet.evaluation.resimulate import resimulated
from polarnet.evaluation.rows import Context, predictions_of
from polarnet.evaluation.score import FrameScore, scene_means, score_sequence
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import MotionConfig
from polarnet.simulation.scenes import SceneStore

CHANNEL_SIGNS = (1, -1, -1, 1)
"""Of the threshold error behind 0, 45, 90 and 135 degrees: opposite within each pair whose difference is S1 or S2."""

SETTINGS: Mapping[str, Sequence[float]] = {
    "threshold_mismatch": (0.0, 0.03, 0.06, 0.12),
    "noise_rate_hz": (0.0, 0.1, 1.0, 5.0),
    "speed": (0.25, 0.5, 1.0, 2.0, 4.0),
    "channel_error": (0.0, 0.05, 0.1, 0.2, 0.4),
}
"""threshold_mismatch: deviation of the contrast threshold between pixels, in natural-log intensity. noise_rate_hz:
shot-noise events a pixel and second. speed: times the configured one. channel_error: relative error of the contrast
threshold of each polarizer's sensor, with `CHANNEL_SIGNS`; a Prophesee sensor's differ by 0.2 to 0.3 over its settings.
"""
SHOWN = ("mse", "psnr", "corr", "skill")


def sensors(setting: str, value: float, emulate: EmulatorConfig) -> list[EmulatorConfig]:
    """The sensors behind the four polarizers with one setting changed; speed changes none of them."""
    if setting == "threshold_mismatch":
        return [dataclasses.replace(emulate, contrast_threshold_sigma=value)] * 4
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
    motion: MotionConfig,
    emulate: EmulatorConfig,
    seed: int,
    warmup_windows: int,
    methods: Sequence[str],
    context: Context,
    settings: Mapping[str, Sequence[float]] = SETTINGS,
    threads: int = 1,
) -> dict[str, list[dict[str, Any]]]:
    """Setting, then its values: events per pixel and second, and each method's mean scores over the sequences' scenes.

    Sequences are emulated again from their stored scenes, with the noise that they were made with. A speed that a
    picture has no room for is left out, and the entry says how many sequences it counts.
    """
    table: dict[str, list[dict[str, Any]]] = {}
    points = [(setting, value) for setting, values in settings.items() for value in values]
    for setting, value in tqdm(points, "sensitivity", unit="setting"):
        rows: list[FrameScore] = []
        rates: list[float] = []
        left_out: list[str] = []
        for sequence in sequences:
            speed = value if setting == "speed" else 1.0
            try:
                test = resimulated(scenes, sequence, motion, sensors(setting, value, emulate), seed, speed, threads)
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
                "scores": {method: _means(rows, method) for method in methods},
            }
            table.setdefault(setting, []).append(entry)
    return table


def _means(rows: Sequence[FrameScore], method: str) -> dict[str, float]:
    of_method = [row for row in rows if row.method == method]
    return {metric: float(np.mean([*scene_means(of_method, metric)[method].values()])) for metric in SHOWN}
