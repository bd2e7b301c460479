import math

import pytest
import torch

from polarnet.metrics.reliability import BINS, reliability


def test_errors_of_the_predicted_size_lie_on_the_diagonal():
    torch.manual_seed(0)
    log_variance = torch.empty(4, 100, 100).uniform_(-8, -4)
    truth = torch.full_like(log_variance, 0.5)
    dolp = truth + torch.randn_like(truth) * (log_variance / 2).exp()
    result = reliability(log_variance, dolp, truth)
    for predicted, measured, pixels in result.curve():
        assert measured == pytest.approx(predicted, rel=0.1)
        assert pixels > 1000
    assert result.log_error() < 0.1
    assert sum(pixels for *_, pixels in result.curve()) == truth.numel()


def test_errors_four_times_as_large_as_expected_are_off_by_ln_4_per_pixel():
    log_variance = torch.full((1, 2, 2), math.log(0.01))
    truth = torch.zeros(1, 2, 2)
    result = reliability(log_variance, truth + 0.2, truth)
    assert result.curve() == [pytest.approx((0.01, 0.04, 4))]
    assert result.log_error() == pytest.approx(math.log(4), rel=1e-5)


def test_sequences_add_up_and_masked_pixels_do_not_count():
    truth, valid = torch.zeros(1, 1, 2), torch.tensor([[[True, False]]])
    one = reliability(torch.tensor([[[-2.2, -2.2]]]), truth + 0.5, truth, valid)
    two = reliability(torch.tensor([[[-30.0, 5.0]]]), truth + 0.5, truth)
    together = one + two
    assert together.pixels.sum() == 3
    assert together.pixels[0] == together.pixels[BINS - 1] == 1
    assert together.measured.sum() == 0.75
    with pytest.raises(ValueError, match="needs pixels"):
        reliability(truth, truth, truth, torch.zeros_like(truth, dtype=torch.bool)).log_error()


def test_a_bin_spans_half_a_unit_of_log_variance_from_minus_12_to_0():
    log_variance = torch.tensor([[[-11.8, -11.3, -6.2, -0.2]]])
    result = reliability(log_variance, torch.zeros(1, 1, 4), torch.ones(1, 1, 4))
    assert result.pixels.nonzero().flatten().tolist() == [0, 1, 11, 23]
    assert len(result.pixels) == 24
