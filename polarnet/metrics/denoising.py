"""Scores of a denoiser: which noise events it removes, and which signal events it costs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8

from polarnet.events.labels import LABELS, SIGNAL
from polarnet.runtime.arrays import Array, as_tensor


class DenoisingScores(NamedTuple):
    """Scores of a denoiser: fractions in [0, 1], NaN where the denominator is 0, and numbers of events."""

    precision: float
    """Fraction of the removed events that are noise."""
    recall: float
    """Fraction of the noise events that are removed."""
    signal_kept: float
    """Fraction of the signal events that are kept."""
    removed: dict[str, tuple[int, int]]
    """For each label, the number of removed events and of all events."""


def denoising_scores(label: UInt8[Array, " n"], keep: Bool[Array, " n"]) -> DenoisingScores:
    """Scores of a denoiser that keeps the events `keep` of those with these labels (numpy or torch).

    The labels are those of `EventStore.read(...)[channel].label`, for a store written with `storage.labels`. Every
    label but `signal` is noise. ValueError for labels that do not exist and for columns of different lengths.
    """
    labels, removed = as_tensor("label", label).numpy(), ~as_tensor("keep", keep).numpy()
    if labels.shape != removed.shape or (labels >= len(LABELS)).any():
        raise ValueError(
            f"expected labels 0 to {len(LABELS) - 1} and as many flags, got {len(labels)} labels up to "
            f"{labels.max(initial=0)} and {len(removed)} flags"
        )
    of_removed, of_all = (np.bincount(each, minlength=len(LABELS)).tolist() for each in (labels[removed], labels))
    noise_removed, noise = sum(of_removed) - of_removed[SIGNAL], sum(of_all) - of_all[SIGNAL]
    return DenoisingScores(
        _fraction(noise_removed, sum(of_removed)),
        _fraction(noise_removed, noise),
        _fraction(of_all[SIGNAL] - of_removed[SIGNAL], of_all[SIGNAL]),
        dict(zip(LABELS, zip(of_removed, of_all, strict=True), strict=True)),
    )


def _fraction(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
