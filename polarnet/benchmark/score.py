"""Scores of predictions: one row per frame, means over frames and then scenes with intervals, paired comparisons."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, NonNegativeInt
from torch import Tensor

from polarnet.benchmark.sequences import TestSequence
from polarnet.methods import ROWS
from polarnet.metrics.lpips import BACKBONES, Lpips
from polarnet.metrics.offset import offset_scores
from polarnet.metrics.similarity import (
    MIN_MSE,
    frame_scores,
    gradient_agreement,
    level_mse,
    pattern_mse,
    with_truth_outside,
)
from polarnet.runtime.machine import generator_for
from polarnet.runtime.sections import one_of, section
from polarnet.stokes import Prediction

SETS = ("simulated", "measured")
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
    offset: float | None
    """`offset.offset_scores`; this and the next are None if the method predicts no angle."""
    no_offset_mse: float | None
    aolp_deg: float | None
    """`similarity.aolp_error_deg`, weighted by the true DoLP; None if the method predicts no angle."""
    oracle_mse: float
    """MSE of the true frame's mean: not a score, but the reference of the skill."""


SCORES = FrameScore._fields[FrameScore._fields.index("mse") :]
METRICS = (*SCORES[:-1], "skill")


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
    which sees the truth there instead of the prediction. ValueError, naming the frame, if no pixel is valid.
    """
    windows = scored_windows(sequence, warmup_windows)

    def scored(frames: Tensor | None) -> Any:
        return None if frames is None else frames[warmup_windows:].to(device)

    counted = {method: Prediction(scored(one.dolp), scored(one.aolp)) for method, one in predictions.items()}
    truth, aolp, valid = scored(sequence.dolp), scored(sequence.aolp), scored(sequence.valid)
    if valid is not None and not (known := valid.any(-1).any(-1)).all():
        window = windows[int(known.logical_not().nonzero()[0])]
        raise ValueError(f"{sequence.name}, window {window}: no pixel is valid; leave this measurement out")
    distances = {} if lpips is None else _lpips_of(counted, truth, valid, lpips)
    rows = []
    for method, prediction in counted.items():
        scores = {
            **frame_scores(prediction, truth, aolp, valid),
            **({"lpips": distances[method]} if method in distances else {}),
            "grad": gradient_agreement(prediction.dolp, truth, valid),
            "level_mse": level_mse(prediction.dolp, truth, valid),
            "pattern_mse": pattern_mse(prediction.dolp, truth, valid),
            **offset_scores(prediction, truth, aolp, valid),
        }
        columns = [scores[name].tolist() if name in scores else [None] * len(windows) for name in SCORES]
        for window, *values in zip(windows, *columns, strict=True):
            t_us = int(sequence.t_us[window + 1])
            rows.append(FrameScore(method, sequence.scene, sequence.name, window, t_us, *values))
    return rows


def scene_means(rows: Iterable[FrameScore], metric: str) -> dict[str, dict[str, float]]:
    """Mean of a column or metric over the frames of each scene, by method and scene, without methods that lack it.

    The skill of a scene is 1 - its MSE / the MSE of the oracle mean.
    """
    if metric == "skill":
        rows = list(rows)
        errors, oracles = scene_means(rows, "mse"), scene_means(rows, "oracle_mse")
        return {
            method: {scene: _skill(error, oracles[method][scene]) for scene, error in scenes.items()}
            for method, scenes in errors.items()
        }
    values: dict[str, dict[str, list[Any]]] = {}
    for row in rows:
        values.setdefault(row.method, {}).setdefault(row.scene, []).append(getattr(row, metric))
    return {
        method: {scene: math.fsum(of_scene) / len(of_scene) for scene, of_scene in sorted(scenes.items())}
        for method, scenes in values.items()
        if None not in itertools.chain(*scenes.values())
    }


def summary(
    rows: Sequence[FrameScore], bootstrap_samples: int, seed: int
) -> dict[str, dict[str, float | list[float] | None]]:
    """Mean over scenes by method and metric, and its 95 % bootstrap interval over scenes as `<metric>_ci`.

    All sequences of one source picture form one scene, since they are not independent. All methods and metrics use
    the same resampled scenes. Skill is 1 - mean MSE / mean MSE of the oracle mean over the same scenes. This ratio of
    means keeps a scene with little variation from outweighing all others. A metric that was not computed is None and
    has no interval.
    """
    scenes = len({row.scene for row in rows})
    resampled = generator_for(seed, "benchmark", "bootstrap").integers(0, scenes, (bootstrap_samples, scenes))
    table: dict[str, dict[str, float | list[float] | None]] = {row.method: {} for row in rows}
    oracles = scene_means(rows, "oracle_mse")
    for metric in METRICS:
        means = scene_means(rows, "mse" if metric == "skill" else metric)
        for method, scores in table.items():
            if method not in means:
                scores[metric] = None
                continue
            values, oracle = (np.array(list(of[method].values())) for of in (means, oracles))
            mean, samples = values.mean(), values[resampled].mean(axis=1)
            if metric == "skill":
                mean = _skill(mean, oracle.mean())
                samples = _skill(samples, oracle[resampled].mean(axis=1))
            scores |= {metric: float(mean), f"{metric}_ci": np.quantile(samples, INTERVAL).tolist()}
    return table


def paired_comparisons(rows: Iterable[FrameScore], method: str) -> dict[str, dict[str, Any]]:
    """Compare the MSE of `method` with that of every other method in `rows`; empty if `rows` lack `method`.

    Each scene gives one pair: the two methods' means over its frames. A comparison holds

    - `scenes`: number of scenes, and `better`: number of scenes where `method` has the smaller error;
    - `median_difference`: `method` minus the other method;
    - `p`: two-sided p-value of Wilcoxon's signed-rank test (exact up to 50 scenes without ties), and `p_holm`: the
      same after Holm's correction (1979) for the number of other methods.

    The test has little power with few scenes: with five, the smallest possible p is 0.0625.
    """
    from scipy.stats import wilcoxon  # a second, which every stage would pay

    errors = scene_means(rows, "mse")
    own = errors.pop(method, {})
    table: dict[str, dict[str, Any]] = {}
    for rival, others in errors.items() if own else ():
        difference = np.array([error - others[scene] for scene, error in own.items()])
        moved = difference[difference != 0]
        table[rival] = {
            "scenes": len(difference),
            "better": int((difference < 0).sum()),
            "median_difference": float(np.median(difference)),
            "p": float(wilcoxon(moved).pvalue) if len(moved) else 1.0,
        }
    reached = 0.0
    for i, comparison in enumerate(sorted(table.values(), key=lambda comparison: comparison["p"])):
        reached = max(reached, min(1.0, comparison["p"] * (len(table) - i)))
        comparison["p_holm"] = reached
    return table


def _skill(error: Any, oracle: Any) -> Any:
    """1 for no error, 0 for the error of the oracle mean, which is at least `MIN_MSE`, the resolution of PSNR."""
    return 1 - error / np.maximum(oracle, MIN_MSE)


def _lpips_of(
    predictions: Mapping[str, Prediction], truth: Float[Tensor, "n h w"], valid: Tensor | None, lpips: Lpips
) -> dict[str, Float[Tensor, " n"]]:
    """Distances by method. Features of the truth are computed once for all methods, those of a constant once."""
    frames = {method: with_truth_outside(one.dolp, truth, valid) for method, one in predictions.items()}
    parts: dict[str, list[Tensor]] = {method: [] for method in frames}
    for start in range(0, len(truth), FRAMES_AT_ONCE):
        chunk = slice(start, start + FRAMES_AT_ONCE)
        of_truth = lpips.features(truth[chunk])
        for method, recovered in frames.items():
            some = recovered[chunk]
            constant = torch.equal(some, some[:1].expand_as(some))
            features = lpips.features(some[:1] if constant else some)
            parts[method].append(lpips.distance([one.expand(len(some), -1, -1, -1) for one in features], of_truth))
    return {method: torch.cat(distances) for method, distances in parts.items()}
