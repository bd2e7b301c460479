"""Sentences that compare `ours` with every other row of a table."""

from collections.abc import Mapping
from typing import Any

from polarnet.reports.legend import LABELS, in_order
from polarnet.reports.tables import COLUMNS, Scores


def standing(scores: Scores, labels: Mapping[str, str] = LABELS) -> list[str]:
    """Comparisons of `ours` with every other method, a sentence each, with the differences; empty without `ours`."""
    if "ours" not in scores:
        return []
    return [
        f"ours against {label}: " + ", ".join(differences) + "."
        for rival, label in labels.items()
        if rival in scores and rival != "ours" and (differences := _differences(scores["ours"], scores[rival]))
    ]


def paired_lines(
    paired: Mapping[str, Mapping[str, Mapping[str, Any]]],
    metric: str = "mse",
    labels: Mapping[str, str] = LABELS,
) -> list[str]:
    """Scene-by-scene comparisons of `ours` with every other method, a sentence each, from details.json's `paired`."""
    return [
        f"{labels.get(rival, rival)}: ours is better in {one['better']} of {one['scenes']} scenes "
        f"(effect {one['effect']:+.2f}, p = {one['p_holm']:.2g})."
        for rival in in_order(paired)
        if (one := paired[rival].get(metric))
    ]


def _differences(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> list[str]:
    words = []
    for key, column in COLUMNS.items():
        a, b = ours.get(key), rival.get(key)
        if column.ranked and a is not None and b is not None:
            better = (a < b) == (column.better == "low") if a != b else None
            verdict = {True: "better", False: "worse", None: "equal"}[better]
            words.append(f"{column.label} {a - b:+.{column.decimals}f}{column.unit} ({verdict})")
    return words
