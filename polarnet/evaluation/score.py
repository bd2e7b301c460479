"""Scores of recovered DoLP: a row per frame, means over frames, then over scenes, with a bootstrap interval."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.evaluation.methods import METHODS, Recording
from polarnet.ranges import allowed, check_ranges
from polarnet.runtime import generator_for
from polarnet.similarity import Lpips, correlation, level_mse, mse, pattern_mse, psnr, ssim, with_truth_outside

METRICS = ("mse", "psnr", "ssim", "lpips", "corr", "level_mse", "pattern_mse")
INTERVAL = (0.025, 0.975)  # quantiles of the bootstrap: 95 %
FRAMES_AT_ONCE = 8  # of LPIPS: bounds the memory that its features need


@dataclass(frozen=True)
class BenchmarkConfig:
    """Section `benchmark` of params.yaml."""

    methods: list[str] = field(metadata=allowed(choices=tuple(METHODS)))
    warmup_windows: int = field(metadata=allowed(low=0))
    """First windows of a sequence that no score counts, for every method alike: nothing has moved far enough yet."""
    precision: str = field(metadata=allowed(choices=("fp32", "bf16")))
    """Of the networks; scores in fp32 do not depend on a processor's bf16 kernels."""
    bootstrap_samples: int = field(metadata=allowed(low=1))
    panel_scenes: int = field(metadata=allowed(low=0))
    """Scenes shown as pictures."""

    def __post_init__(self):
        check_ranges(self)
        if not self.methods or len(set(self.methods)) != len(self.methods):
            raise ValueError(f"methods: expected at least one and none twice, got {self.methods}")


class FrameScore(NamedTuple):
    """How one recovered frame compares with the truth; the columns of frames.csv."""

    method: str
    scene: str
    sequence: str
    window: int
    """Counted from 0 in the sequence; the frame is the one at the window's end."""
    t_us: int
    mse: float
    psnr: float
    ssim: float
    lpips: float | None
    """None without LPIPS weights."""
    corr: float
    level_mse: float
    pattern_mse: float


def scored_windows(recording: Recording, warmup_windows: int) -> range:
    """Windows that count; ValueError where the warm-up leaves none."""
    if len(recording.dolp) <= warmup_windows:
        raise ValueError(
            f"{recording.name} has {len(recording.dolp)} windows and the first {warmup_windows} are warm-up: nothing "
            f"is left to score; lower benchmark.warmup_windows or lengthen the sequences"
        )
    return range(warmup_windows, len(recording.dolp))


@torch.no_grad()
def score_sequence(
    recording: Recording,
    recovered: Mapping[str, Float[Tensor, "n h w"]],
    warmup_windows: int,
    lpips: Lpips | None,
    device: torch.device,
) -> list[FrameScore]:
    """A row per method and window after the warm-up; `recovered` is each method's DoLP, a frame a window.

    Computed on `device`, where `lpips` has to be. Pixels that are not valid count in no score but LPIPS, which sees the
    truth there in place of the method's answer.

    ValueError, which names the frame, for a score that is not a number, or a frame without a valid pixel: no frame is
    ever left out.
    """
    windows = scored_windows(recording, warmup_windows)
    truth = recording.dolp[warmup_windows:].to(device)
    valid = None if recording.valid is None else recording.valid[warmup_windows:].to(device)
    if valid is not None and not (known := valid.any(-1).any(-1)).all():
        window = warmup_windows + int(known.logical_not().nonzero()[0])
        raise ValueError(f"{recording.name}, window {window}: no pixel is valid; leave this measurement out")
    for method, frames in recovered.items():
        if frames.shape != recording.dolp.shape:
            raise ValueError(
                f"{method} on {recording.name}: expected frames of {tuple(recording.dolp.shape)}, "
                f"got {tuple(frames.shape)}"
            )
    counted = {method: frames[warmup_windows:].to(device) for method, frames in recovered.items()}
    shown = {method: with_truth_outside(frames, truth, valid) for method, frames in counted.items()}
    distances = _lpips_of(shown, truth, lpips)
    rows = []
    for method, frames in counted.items():
        per_frame = {
            "mse": mse(frames, truth, valid),
            "psnr": psnr(frames, truth, valid),
            "ssim": ssim(frames, truth, valid),
            "corr": correlation(frames, truth, valid),
            "level_mse": level_mse(frames, truth, valid),
            "pattern_mse": pattern_mse(frames, truth, valid),
        } | ({} if distances is None else {"lpips": distances[method]})
        columns = {name: values.tolist() for name, values in per_frame.items()}
        for i, window in enumerate(windows):
            scores = {"lpips": None} | {name: values[i] for name, values in columns.items()}
            t_us = int(recording.t_us[window + 1])
            rows.append(_finite(FrameScore(method, recording.scene, recording.name, window, t_us, **scores)))
    return rows


def scene_means(rows: Iterable[FrameScore], metric: str) -> dict[str, dict[str, float]] | None:
    """Method, then scene: the mean over the scene's frames; None where the metric was not computed."""
    gathered: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if (value := getattr(row, metric)) is None:
            return None
        gathered.setdefault(row.method, {}).setdefault(row.scene, []).append(value)
    return {
        method: {scene: math.fsum(values) / len(values) for scene, values in sorted(scenes.items())}
        for method, scenes in gathered.items()
    }


def summary(
    rows: Sequence[FrameScore], bootstrap_samples: int, seed: int
) -> dict[str, dict[str, float | list[float] | None]]:
    """Method, then metric: the mean over scenes, and as `<metric>_ci` its 95 % bootstrap interval over scenes.

    A scene is one source picture, however many sequences were made from it: those are not independent. All methods
    and metrics see the same resampled scenes. A metric that was not computed is None and has no interval.
    ValueError where a method lacks a scene.
    """
    methods = list(dict.fromkeys(row.method for row in rows))
    scenes = sorted({row.scene for row in rows})
    generator = generator_for(seed, "benchmark", "bootstrap")
    resampled = generator.integers(0, len(scenes), (bootstrap_samples, len(scenes)))
    table: dict[str, dict[str, float | list[float] | None]] = {method: {} for method in methods}
    for metric in METRICS:
        means = scene_means(rows, metric)
        for method in methods:
            if means is None:
                table[method][metric] = None
                continue
            if list(means[method]) != scenes:
                raise ValueError(f"{method} has no score for {sorted(set(scenes) - set(means[method]))}")
            values = np.array(list(means[method].values()))
            table[method][metric] = float(values.mean())
            table[method][f"{metric}_ci"] = np.quantile(values[resampled].mean(axis=1), INTERVAL).tolist()
    return table


def write_frames(path: Path, rows: Iterable[FrameScore]) -> None:
    """Write rows as CSV with a header; an empty cell is a metric that was not computed."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FrameScore._fields)
        writer.writerows(rows)


def _lpips_of(
    recovered: Mapping[str, Float[Tensor, "n h w"]], truth: Float[Tensor, "n h w"], lpips: Lpips | None
) -> dict[str, Float[Tensor, " n"]] | None:
    if lpips is None:
        return None
    parts: dict[str, list[Tensor]] = {method: [] for method in recovered}
    for start in range(0, len(truth), FRAMES_AT_ONCE):
        chunk = slice(start, start + FRAMES_AT_ONCE)
        of_truth = lpips.features(truth[chunk])
        for method, frames in recovered.items():
            parts[method].append(lpips.distance(lpips.features(frames[chunk]), of_truth))
    return {method: torch.cat(distances) for method, distances in parts.items()}


def _finite(row: FrameScore) -> FrameScore:
    for metric in METRICS:
        value = getattr(row, metric)
        if value is not None and not math.isfinite(value):
            raise ValueError(
                f"{row.method} on {row.sequence}, window {row.window}: {metric} is {value}; the method or the truth "
                f"holds values that are not numbers"
            )
    return row
