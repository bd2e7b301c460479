"""Is one method better than another on the same scenes: Wilcoxon's signed-rank test over scenes, and by how much."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.stats import rankdata, wilcoxon

from polarnet.evaluation.score import FrameScore, scene_means

PAIRED_METRICS = {
    "mse": "low", "psnr": "high", "ssim": "high", "lpips": "low", "corr": "high", "grad": "high",
    "pattern_mse": "low", "aolp_deg": "low",
}  # fmt: skip
"""What is compared, and which way it improves."""


def paired_comparisons(rows: Iterable[FrameScore], method: str) -> dict[str, dict[str, dict[str, Any]]]:
    """`method` against each other method that `rows` hold, then by metric; empty where `rows` lack `method`.

    A scene is one pair: its mean of one method and of the other. Each comparison says

    - `scenes`: how many there are, and `better`: in how many of them `method` is;
    - `median_difference`: `method` minus the other, in the metric's own unit;
    - `effect`: the rank-biserial correlation of the pairs (Kerby, Comprehensive Psychology 2014): 1 where `method` is
      better in every scene, -1 where it is worse in every scene, 0 where neither stands out;
    - `p`: two-sided, of Wilcoxon's signed-rank test (exact up to 50 scenes without ties), and `p_holm`: the same
      corrected for as many comparisons as there are other methods (Holm, 1979).

    Few scenes cannot show much: with five, the smallest possible p is 0.0625.
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
    """Scenes, better, effect and p of how much each scene gained; ties of 0 count for neither side."""
    moved = gains[gains != 0]
    effect, p = 0.0, 1.0
    if len(moved):
        ranks = rankdata(np.abs(moved))
        effect = float((ranks * np.sign(moved)).sum() / ranks.sum())
        p = float(wilcoxon(moved).pvalue)
    return {"scenes": len(gains), "better": int((gains > 0).sum()), "effect": effect, "p": p}


def _correct(comparisons: Sequence[dict[str, Any]]) -> None:
    """Add `p_holm`: the smallest p times the number of tests, the next times one less, and never falling."""
    reached = 0.0
    for i, comparison in enumerate(sorted(comparisons, key=lambda comparison: comparison["p"])):
        reached = max(reached, min(1.0, comparison["p"] * (len(comparisons) - i)))
        comparison["p_holm"] = reached
