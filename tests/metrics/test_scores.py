"""Means of the frame scores, worked out by hand."""

import math

import pytest
import torch

from polarnet.metrics.scores import frame_scores, score
from polarnet.stokes import Prediction

DOLP = torch.full((3, 8, 8), 0.5)
OFFSETS = torch.tensor([0.4, 0.2, 0.1]).view(3, 1, 1)
"""Error of DoLP in each frame: squared 0.16, 0.04 and 0.01."""


def test_the_mean_covers_the_frames_after_the_warmup():
    prediction = Prediction(DOLP + OFFSETS)
    expected = {0: 0.07, 1: 0.025, 2: 0.01}
    for warmup, mse in expected.items():
        assert score(prediction, DOLP, DOLP, warmup)["mse"] == pytest.approx(mse, abs=1e-6)
    assert score(prediction, DOLP, DOLP)["mse"] == pytest.approx(0.07, abs=1e-6)


@pytest.mark.parametrize("warmup", [-1, 3])
def test_a_warmup_that_leaves_no_frame_is_refused(warmup):
    with pytest.raises(ValueError, match=f"expected 0 to 2, got {warmup}"):
        score(Prediction(DOLP), DOLP, DOLP, warmup)


def test_an_angle_is_scored_if_the_method_predicts_one():
    assert "aolp_deg" not in frame_scores(Prediction(DOLP), DOLP, DOLP)
    turned = Prediction(DOLP, aolp=DOLP + math.radians(10))
    assert frame_scores(turned, DOLP, DOLP)["aolp_deg"].tolist() == pytest.approx([10, 10, 10], abs=1e-4)
