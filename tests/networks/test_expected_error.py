import math

import pytest
import torch

from polarnet.networks.polarnet.expected_error import (
    BASIC,
    FEATURES,
    MIN_DISAGREEMENT,
    MIN_ROOM,
    UNFITTED,
    USUAL_DISAGREEMENT,
    USUAL_ROOM,
    ExpectedError,
    error_features,
)

EVEN = torch.full((1, 2, 4, 6), 0.5)


def features(candidates=EVEN, weights=EVEN, evidence=EVEN, dolp=0.5):
    return error_features(candidates, weights, evidence, torch.full((1, 1, 16, 24), dolp))


def test_candidates_that_agree_say_the_least_and_the_others_how_far_they_are_apart():
    assert features().shape == (1, FEATURES, 8, 12)
    agree = math.log(MIN_DISAGREEMENT / USUAL_DISAGREEMENT)
    apart, of_frame, _, _ = features()[0, :BASIC]
    assert apart.unique().item() == of_frame.unique().item() == pytest.approx(agree)
    candidates = EVEN.clone()
    candidates[:, 0, :, 3:] = 0.9
    apart, of_frame, _, _ = features(candidates)[0, :BASIC]
    disagree = math.log((0.2**2 + MIN_DISAGREEMENT) / USUAL_DISAGREEMENT)
    assert apart[:, -1].unique().item() == pytest.approx(disagree)
    assert of_frame.unique().item() == pytest.approx((disagree + agree) / 2)


def test_candidates_count_if_trusted_and_frames_without_evidence_are_told_apart():
    candidates, weights = EVEN.clone(), EVEN.clone()
    candidates[:, 0], weights[:, 0] = 0.9, 0.0
    torch.testing.assert_close(features(candidates, weights), features())
    assert features(candidates, 0 * weights).isfinite().all()
    silence = [features(evidence=share * EVEN)[0, 2].unique().item() for share in (100, 0.2, 0)]
    assert silence == pytest.approx([0, 0.5, 1], abs=0.01)
    evidence = 0 * EVEN
    evidence[..., 0] = 60.0
    assert features(evidence=evidence)[0, 2].unique().item() < 0.01
    assert features(dolp=0.2)[0, 3].unique().item() == pytest.approx(math.log((0.16 + MIN_ROOM) / USUAL_ROOM))
    assert features(dolp=-0.1)[0, 3].unique().item() == features(dolp=1.1)[0, 3].unique().item()


def test_squares_and_products_follow_and_one_error_is_expected_until_the_fit():
    candidates, evidence = EVEN.clone(), 0.1 * EVEN
    candidates[:, 0, :, 3:] = 0.9
    computed = features(candidates, evidence=evidence, dolp=0.2)[0]
    basic = computed[:BASIC]
    pairs = [basic[j] * basic[k] for j in range(BASIC) for k in range(j, BASIC)]
    torch.testing.assert_close(computed[BASIC:], torch.stack(pairs))
    expected = ExpectedError()
    assert not [*expected.parameters()]
    assert expected(torch.randn(2, FEATURES, 3, 5)).unique().tolist() == [UNFITTED]
    expected.weight[0], expected.weight[-1] = 1.0, 2.0
    expected.bias.fill_(-3.0)
    inputs = torch.randn(2, FEATURES, 3, 5)
    torch.testing.assert_close(expected(inputs), inputs[:, :1] + 2 * inputs[:, -1:] - 3)
