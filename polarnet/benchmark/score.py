"""Scores of predictions: one row per frame, means over frames and then scenes, with bootstrap intervals."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, NonNegativeInt
from torch import Tensor

from polarnet.benchmark.sequences import TestSequence
from polarnet.methods import ROWS
from polarnet.metrics.lpips import BACKBONES
from polarnet.metrics.similarity import (
    MIN_MSE,
    Lpips,
    aolp_error_deg,
    correlation,
    gradient_agreement,
    level_mse,
    mse,
    pattern_mse,
    psnr,
    spread_mse,
    ssim,
    with_truth_outside,
)
from polarnet.runtime.machine import generator_for
from polarnet.runtime.sections import one_of, section
from polarnet.stokes import Prediction

METRICS = ("mse", "psnr", "ssim", "lpips", "corr", "grad", "level_mse", "pattern_mse", "aolp_deg", "skill")
SETS = ("simulated", "complex_motion", "measured")
"""Test sets: the pipeline's held-out sequences, the same pictures under harder motion, measured polarization."""

INTERVAL = (0.025, 0.975)  # quantiles of the bootstrap: 95 %
FRAMES_AT_ONCE = 8  # batch size of LPIPS, which bounds the memory of its features


@section
class BenchmarkConfig:
    """Section `benchmark` of params.yaml."""

    methods: list[Annotated[str, one_of(ROWS)]]
    """Rows of the table: references and methods."""
    sets: list[Annotated[str, one_of(SETS)]]
    """Test sets; must include simulated."""
    warmup_windows: NonNegativeInt
    """Unscored windows at the start of a sequence, the same for all methods: nothing has moved far enough yet."""
    precision: Annotated[str, one_of(("fp32", "bf16"))]
    """Precision of the networks; scores in fp32 do not depend on a processor's bf16 kernels."""
    lpips: bool
    """Whether to compute LPIPS."""
    lpips_backbone: Annotated[str, one_of(BACKBONES)]
    """Backbone of LPIPS, always in fp32; the paper uses vgg."""
    bootstrap_samples: Annotated[int, Field(gt=0, le=1_000_000)]
    panel_scenes: NonNegativeInt
    """Number of scenes shown as panels."""

    def __post_init__(self):
        if not self.methods or len(set(self.methods)) != len(self.methods):
            raise ValueError(f"methods: expected at least one and none twice, got {self.methods}")
        if SETS[0] not in self.sets or len(set(self.sets)) != len(self.sets):
            raise ValueError(f"sets: expected {SETS[0]} and others, none twice, got {self.sets}")


class FrameScore(NamedTuple):
    """Scores of one predicted frame; the columns of frames.csv."""

    method: str
    scene: str
    sequence: str
    window: int
    """Index of the window in the sequence, from 0; the frame is at the window's end."""
    t_us: int
    mse: float
    psnr: float
    ssim: float
    lpips: float | None
    """None unless LPIPS is computed."""
    corr: float
    grad: float
    """`similarity.gradient_agreement`."""
    level_mse: float
    pattern_mse: float
    aolp_deg: float | None
    """`similarity.aolp_error_deg`, weighted by the true DoLP; None if the method predicts no angle."""
    oracle_mse: float
    """MSE of the true frame's mean: not a score, but the reference of the skill."""


@dataclass(frozen=True)
class Cost:
    """Cost of a method; times and arithmetic are per window of all four channels."""

    ms_per_window: float
    """Time from events in memory to a DoLP frame in memory, including encoding the input."""
    gflop: float | None
    """Convolutions, matrix products and attention; a multiply-add counts as 2. None for a method without a network."""
    params: int
    """Parameters of the method's networks."""


def scored_windows(sequence: TestSequence, warmup_windows: int) -> range:
    """Indices of the scored windows; ValueError if the warm-up leaves none."""
    if len(sequence.dolp) <= warmup_windows:
        raise ValueError(
            f"{sequence.name} has {len(sequence.dolp)} windows and the first {warmup_windows} are warm-up: nothing "
            f"is left to score; lower benchmark.warmup_windows or lengthen the sequences"
        )
    return range(warmup_windows, len(sequence.dolp))


@torch.no_grad()
def score_sequence(
    sequence: TestSequence,
    predictions: Mapping[str, Prediction],
    warmup_windows: int,
    lpips: Lpips | None,
    device: torch.device,
) -> list[FrameScore]:
    """One row per method and window after the warm-up; `predictions` hold one frame per window.

    Scores are computed on `device`, where `lpips` must be. Invalid pixels are excluded from all scores except LPIPS,
    which sees the truth there instead of the prediction.

    ValueError, naming the frame, if a score is not finite or a frame has no valid pixel: frames are never left out.
    """
    windows = scored_windows(sequence, warmup_windows)
    for method, prediction in predictions.items():
        for frames in (prediction.dolp, prediction.aolp):
            if frames is not None and frames.shape != sequence.dolp.shape:
                raise ValueError(
                    f"{method} on {sequence.name}: expected frames of {tuple(sequence.dolp.shape)}, "
                    f"got {tuple(frames.shape)}"
                )

    def scored(frames: Tensor | None) -> Any:
        return None if frames is None else frames[warmup_windows:].to(device)

    counted = {method: (scored(one.dolp), scored(one.aolp)) for method, one in predictions.items()}
    truth, true_aolp, valid = scored(sequence.dolp), scored(sequence.aolp), scored(sequence.valid)
    if valid is not None and not (known := valid.any(-1).any(-1)).all():
        window = warmup_windows + int(known.logical_not().nonzero()[0])
        raise ValueError(f"{sequence.name}, window {window}: no pixel is valid; leave this measurement out")
    oracle_mse = spread_mse(truth, valid)
    compared = {method: with_truth_outside(dolp, truth, valid) for method, (dolp, _) in counted.items()}
    distances = {} if lpips is None else _lpips_of(compared, truth, lpips)
    rows = []
    for method, (dolp, aolp) in counted.items():
        per_frame: dict[str, Tensor | None] = {
            "mse": mse(dolp, truth, valid),
            "psnr": psnr(dolp, truth, valid),
            "ssim": ssim(dolp, truth, valid),
            "lpips": distances.get(method),
            "corr": correlation(dolp, truth, valid),
            "grad": gradient_agreement(dolp, truth, valid),
            "level_mse": level_mse(dolp, truth, valid),
            "pattern_mse": pattern_mse(dolp, truth, valid),
            "aolp_deg": None if aolp is None else aolp_error_deg(aolp, true_aolp, truth, valid),
            "oracle_mse": oracle_mse,
        }
        columns = {name: values.tolist() for name, values in per_frame.items() if values is not None}
        for i, window in enumerate(windows):
            scores: dict[str, Any] = dict.fromkeys(per_frame) | {name: values[i] for name, values in columns.items()}
            t_us = int(sequence.t_us[window + 1])
            rows.append(_finite(FrameScore(method, sequence.scene, sequence.name, window, t_us, **scores)))
    return rows


def scene_means(rows: Iterable[FrameScore], metric: str) -> dict[str, dict[str, float]]:
    """Mean of a column or metric over the frames of each scene, by method and scene.

    The skill of a scene is 1 - its MSE / the MSE of the oracle mean. A method without the metric is left out;
    ValueError if only some of its frames have the metric.
    """
    if metric == "skill":
        rows = list(rows)
        errors, oracles = scene_means(rows, "mse"), scene_means(rows, "oracle_mse")
        return {
            method: {scene: _skill(error, oracles[method][scene]) for scene, error in scenes.items()}
            for method, scenes in errors.items()
        }
    gathered: dict[str, dict[str, list[float | None]]] = {}
    for row in rows:
        gathered.setdefault(row.method, {}).setdefault(row.scene, []).append(getattr(row, metric))
    means: dict[str, dict[str, float]] = {}
    for method, scenes in gathered.items():
        missing = sum(values.count(None) for values in scenes.values())
        if missing == sum(map(len, scenes.values())):
            continue
        if missing:
            raise ValueError(f"{method} has no {metric} for {missing} of its frames; a metric leaves no frame out")
        means[method] = {scene: math.fsum(values) / len(values) for scene, values in sorted(scenes.items())}  # type: ignore[arg-type]
    return means


def mean_scores(rows: Sequence[FrameScore], metrics: Sequence[str]) -> dict[str, dict[str, float]]:
    """Mean over scenes by method and metric; a method lacks the metrics that were not computed for it."""
    means = {metric: scene_means(rows, metric) for metric in metrics}
    return {
        method: {name: float(np.mean([*of[method].values()])) for name, of in means.items() if method in of}
        for method in dict.fromkeys(row.method for row in rows)
    }


def summary(
    rows: Sequence[FrameScore], bootstrap_samples: int, seed: int
) -> dict[str, dict[str, float | list[float] | None]]:
    """Mean over scenes by method and metric, and its 95 % bootstrap interval over scenes as `<metric>_ci`.

    All sequences of one source picture form one scene, since they are not independent. All methods and metrics use
    the same resampled scenes. Skill is 1 - mean MSE / mean MSE of the oracle mean over the same scenes. This ratio of
    means keeps a scene with little variation from outweighing all others. A metric that was not computed is None and
    has no interval. ValueError if a method lacks a scene.
    """
    methods = list(dict.fromkeys(row.method for row in rows))
    scenes = sorted({row.scene for row in rows})
    generator = generator_for(seed, "benchmark", "bootstrap")
    resampled = generator.integers(0, len(scenes), (bootstrap_samples, len(scenes)))
    table: dict[str, dict[str, float | list[float] | None]] = {method: {} for method in methods}
    oracles = scene_means(rows, "oracle_mse")
    for metric in METRICS:
        means = scene_means(rows, "mse" if metric == "skill" else metric)
        for method in methods:
            if method not in means:
                table[method][metric] = None
                continue
            if list(means[method]) != scenes:
                raise ValueError(f"{method} has no score for {sorted(set(scenes) - set(means[method]))}")
            values = np.array(list(means[method].values()))
            mean, samples = values.mean(), values[resampled].mean(axis=1)
            if metric == "skill":
                oracle = np.array(list(oracles[method].values()))
                mean = _skill(mean, oracle.mean())
                samples = _skill(samples, oracle[resampled].mean(axis=1))
            table[method][metric] = float(mean)
            table[method][f"{metric}_ci"] = np.quantile(samples, INTERVAL).tolist()
    return table


def write_frames(path: Path, rows: Iterable[FrameScore]) -> None:
    """Write rows as CSV with a header; metrics that were not computed are empty cells."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FrameScore._fields)
        writer.writerows(rows)


def _skill(error: Any, oracle: Any) -> Any:
    """1 for no error, 0 for the error of the oracle mean, which is at least `MIN_MSE`, the resolution of PSNR."""
    return 1 - error / np.maximum(oracle, MIN_MSE)


def _lpips_of(
    recovered: Mapping[str, Float[Tensor, "n h w"]], truth: Float[Tensor, "n h w"], lpips: Lpips
) -> dict[str, Float[Tensor, " n"]]:
    parts: dict[str, list[Tensor]] = {method: [] for method in recovered}
    for start in range(0, len(truth), FRAMES_AT_ONCE):
        chunk = slice(start, start + FRAMES_AT_ONCE)
        of_truth = lpips.features(truth[chunk])
        for method, frames in recovered.items():
            parts[method].append(lpips.distance(_features_of(frames[chunk], lpips), of_truth))
    return {method: torch.cat(distances) for method, distances in parts.items()}


def _features_of(frames: Float[Tensor, "n h w"], lpips: Lpips) -> list[Float[Tensor, "n _c _h _w"]]:
    """LPIPS features of frames, computed only once if all frames are equal (constant predictions)."""
    if torch.equal(frames, frames[:1].expand_as(frames)):
        return [features.expand(len(frames), -1, -1, -1) for features in lpips.features(frames[:1])]
    return lpips.features(frames)


def _finite(row: FrameScore) -> FrameScore:
    for metric in FrameScore._fields[FrameScore._fields.index("mse") :]:
        value = getattr(row, metric)
        if value is not None and not math.isfinite(value):
            raise ValueError(
                f"{row.method} on {row.sequence}, window {row.window}: {metric} is {value}; the method or the truth "
                f"holds values that are not numbers"
            )
    return row
