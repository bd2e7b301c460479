"""Paired comparison of two methods on the same scenes: Wilcoxon's signed-rank test and effect size."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.stats import rankdata, wilcoxon

from polarnet.benchmark.score import FrameScore, scene_means

PAIRED_METRICS = {
    "mse": "low", "psnr": "high", "ssim": "high", "lpips": "low", "corr": "high", "grad": "high",
    "pattern_mse": "low", "aolp_deg": "low",
}  # fmt: skip
"""Metrics to compare, and whether lower or higher is better."""


def paired_comparisons(rows: Iterable[FrameScore], method: str) -> dict[str, dict[str, dict[str, Any]]]:
    """Compare `method` with every other method in `rows`, metric by metric; empty if `rows` lack `method`.

    Each scene gives one pair: the two methods' means over its frames. A comparison holds

    - `scenes`: number of scenes, and `better`: number of scenes where `method` is better;
    - `median_difference`: `method` minus the other method, in the unit of the metric;
    - `effect`: rank-biserial correlation of the pairs (Kerby, Comprehensive Psychology 2014): 1 if `method` is better
      in every scene, -1 if it is worse in every scene, 0 if neither stands out;
    - `p`: two-sided p-value of Wilcoxon's signed-rank test (exact up to 50 scenes without ties), and `p_holm`: the
      same after Holm's correction (1979) for the number of other methods.

    The test has little power with few scenes: with five, the smallest possible p is 0.0625.
    """
    rows = list(rows)
    means = {metric: scene_means(rows, metric) for metric in PAIRED_METRICS}
    rivals = [name for name in dict.fromkeys(row.method for row in rows) if name != method]
    table: dict[str, dict[str, dict[str, Any]]] = {rival: {} for rival in rivals}
    for metric, better in PAIRED_METRICS.items():
        of = means[metric]
        if method not in of:
            continue
        for rival in [name for name in rivals if name in of]:
            difference = np.array([value - of[rival][scene] for scene, value in of[method].items()])
            table[rival][metric] = compared(difference if better == "high" else -difference) | {
                "median_difference": float(np.median(difference))
            }
        _correct([table[rival][metric] for rival in rivals if metric in table[rival]])
    return {rival: scores for rival, scores in table.items() if scores}


def compared(gains: Float64[np.ndarray, " scenes"]) -> dict[str, Any]:
    """`scenes`, `better`, `effect` and `p` from the gain in each scene; a gain of 0 counts for neither method."""
    moved = gains[gains != 0]
    effect, p = 0.0, 1.0
    if len(moved):
        ranks = rankdata(np.abs(moved))
        effect = float((ranks * np.sign(moved)).sum() / ranks.sum())
        p = float(wilcoxon(moved).pvalue)
    return {"scenes": len(gains), "better": int((gains > 0).sum()), "effect": effect, "p": p}


def _correct(comparisons: Sequence[dict[str, Any]]) -> None:
    """Add `p_holm`: the k-th smallest of n p-values times n + 1 - k, at most 1 and never decreasing in k."""
    reached = 0.0
    for i, comparison in enumerate(sorted(comparisons, key=lambda comparison: comparison["p"])):
        reached = max(reached, min(1.0, comparison["p"] * (len(comparisons) - i)))
        comparison["p_holm"] = reached
