"""Scores of a denoiser, worked out by hand."""

import math

import numpy as np
import pytest
import torch

from polarnet.events.labels import LABELS
from polarnet.metrics.denoising import denoising_scores
from polarnet.simulation.pixels import columns

SIGNAL, LEAK, SHOT, HOT = range(4)


def test_one_signal_and_two_of_three_noise_events_removed():
    label = np.array([SIGNAL, LEAK, SHOT, HOT, SIGNAL, SIGNAL, SIGNAL], np.uint8)
    keep = np.array([True, True, False, False, False, True, True])
    scores = denoising_scores(label, keep)
    assert scores[:3] == (2 / 3, 2 / 3, 3 / 4)
    assert scores.removed == {"signal": (1, 4), "leak": (0, 1), "shot": (1, 1), "hot": (1, 1)}
    assert denoising_scores(torch.from_numpy(label), torch.from_numpy(keep)) == scores


def test_a_denoiser_that_removes_nothing_has_no_precision():
    scores = denoising_scores(np.array([SIGNAL, SHOT], np.uint8), np.array([True, True]))
    assert math.isnan(scores.precision)
    assert scores[1:3] == (0.0, 1.0)
    assert math.isnan(denoising_scores(np.array([SIGNAL], np.uint8), np.array([True])).recall)


def test_labels_that_do_not_exist_and_other_lengths_are_refused():
    with pytest.raises(ValueError, match="expected labels 0 to 3 and as many flags, got 1 labels up to 4 and 1 flags"):
        denoising_scores(np.array([4], np.uint8), np.array([True]))


def test_the_names_of_the_labels_are_those_of_the_pixel_models():
    for name in ("signal", "leak", "shot", "hot"):
        assert LABELS[getattr(columns, name.upper())] == name
