import math

import numpy as np
import pytest
import torch
from skimage.filters import sobel_h, sobel_v
from skimage.metrics import mean_squared_error, peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure

from polarnet.metrics.reliability import BINS, reliability
from polarnet.metrics.similarity import (
    aolp_error_deg,
    correlation,
    frame_scores,
    gradient_agreement,
    level_mse,
    mse,
    pattern_mse,
    psnr,
    spread_mse,
    ssim,
)
from polarnet.stokes import Prediction


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(3)
    smooth = torch.linspace(0, 1, 31).expand(2, 24, 31)
    return smooth.clone(), (smooth + 0.2 * torch.rand(2, 24, 31, generator=generator)).clamp(0, 1)


def test_an_offset_of_a_tenth_is_20_db_and_all_level_and_equal_frames_have_100_db(pair):
    a, b = torch.full((3, 8, 8), 0.5), torch.full((3, 8, 8), 0.6)
    torch.testing.assert_close(mse(a, b), torch.full((3,), 0.01))
    torch.testing.assert_close(psnr(a, b), torch.full((3,), 20.0))
    torch.testing.assert_close(level_mse(a, b), mse(a, b))
    torch.testing.assert_close(pattern_mse(a, b), torch.zeros(3), atol=1e-12, rtol=0)
    a, _ = pair
    assert psnr(a, a).tolist() == [100.0, 100.0]
    torch.testing.assert_close(ssim(a, a), torch.ones(2))
    torch.testing.assert_close(correlation(a, a), torch.ones(2))
    torch.testing.assert_close(correlation(a, 0.3 * a + 0.1), torch.ones(2))
    torch.testing.assert_close(correlation(a, 1 - a), -torch.ones(2))


@pytest.mark.parametrize("value", [0.0, 0.1, 1 / 3])
def test_a_constant_frame_correlates_0_with_anything_and_has_a_gradient(pair, value):
    constant = torch.full((2, 24, 31), value, requires_grad=True)
    scores = correlation(constant, pair[0])
    assert scores.tolist() == [0.0, 0.0]
    scores.sum().backward()
    assert constant.grad.isfinite().all()


def test_ssim_is_that_of_torchmetrics_and_has_the_gradient_of_its_finite_differences(pair):
    a, b = (x.double() for x in pair)
    for i in range(2):
        expected = structural_similarity_index_measure(
            b[i][None, None], a[i][None, None], gaussian_kernel=True, sigma=1.5, kernel_size=11, data_range=1.0
        )
        torch.testing.assert_close(ssim(a, b)[i], expected, rtol=1e-7, atol=0)
        assert ssim(*(x.float() for x in (a, b)))[i].item() == pytest.approx(expected.item(), rel=1e-4)
    a, b = (image[:1, :7, :6].double() for image in pair)
    assert torch.autograd.gradcheck(lambda x: ssim(x, b), a.requires_grad_())
    with torch.autocast("cpu", torch.bfloat16):
        inside = ssim(*pair)
    assert torch.equal(inside, ssim(*pair))


def test_mse_psnr_and_correlation_are_those_of_scikit_image_and_numpy_and_level_and_pattern_add_up(pair):
    a, b = (x.double() for x in pair)
    for i in range(2):
        pictures = b[i].numpy(), a[i].numpy()
        assert mse(a, b)[i].item() == pytest.approx(mean_squared_error(*pictures), rel=1e-12)
        assert psnr(a, b)[i].item() == pytest.approx(peak_signal_noise_ratio(*pictures, data_range=1), rel=1e-12)
        expected = np.corrcoef(pictures[0].flatten(), pictures[1].flatten())[0, 1]
        assert correlation(a, b)[i].item() == pytest.approx(expected, rel=1e-6)
    _, b = pair
    torch.testing.assert_close(spread_mse(b), mse(b.mean(dim=(-2, -1), keepdim=True).expand_as(b), b))
    a, b = (x.double() for x in pair)
    torch.testing.assert_close(level_mse(a, b) + pattern_mse(a, b), mse(a, b), rtol=1e-12, atol=0)


def test_gradients_of_equal_ramps_agree_and_agreement_is_that_of_scikit_images_sobel(pair):
    ramp = torch.linspace(0, 1, 9).expand(7, 9)
    assert gradient_agreement(ramp, ramp + 0.1).item() == pytest.approx(1)
    assert gradient_agreement(ramp, 0.5 * ramp).item() == pytest.approx(2 * 0.5 / (1 + 0.25))
    assert gradient_agreement(ramp, -ramp).item() == pytest.approx(-1)
    assert gradient_agreement(torch.full((7, 9), 1 / 3), ramp).item() == 0
    assert gradient_agreement(ramp, torch.linspace(0, 1, 7)[:, None].expand(7, 9)).item() == pytest.approx(0, abs=1e-7)
    a, b = (x.double() for x in pair)
    # scikit-image's kernels sum to 1 on either side of the centre; ours take the slope per pixel: half as much
    along = [[f(x[0].numpy())[1:-1, 1:-1] for f in (sobel_h, sobel_v)] for x in (a, b)]
    common = sum((x * y).sum() for x, y in zip(*along, strict=True))
    energy = sum((x * x).sum() for gradient in along for x in gradient)
    assert gradient_agreement(a, b)[0].item() == pytest.approx(2 * common / energy, rel=1e-12)


@pytest.mark.parametrize(("metric", "side"), [(gradient_agreement, 3), (ssim, 6)])
def test_a_frame_smaller_than_its_neighbourhood_is_refused(metric, side):
    with pytest.raises(ValueError, match=rf"at least {side} pixels a side, got \({side - 1}, 40\)"):
        metric(torch.zeros(side - 1, 40), torch.zeros(side - 1, 40))


@pytest.mark.parametrize(
    ("a_deg", "b_deg", "error"), [(10, 30, 20), (175, 5, 10), (0, 90, 90), (0, 180, 0), (1, 179, 2), (40, 140, 80)]
)
def test_the_angle_between_two_orientations_goes_the_shorter_way_round(a_deg, b_deg, error):
    a, b = (torch.full((1, 2, 2), float(np.deg2rad(x)), dtype=torch.float64) for x in (a_deg, b_deg))
    assert aolp_error_deg(a, b, torch.ones(1, 2, 2)).item() == pytest.approx(error, abs=1e-9)
    assert aolp_error_deg(b, a, torch.ones(1, 2, 2)).item() == pytest.approx(error, abs=1e-9)


def test_an_angle_weighs_as_much_as_the_light_is_polarized_and_is_else_right_by_chance():
    error = torch.tensor([[0.0, np.deg2rad(40)]])
    assert aolp_error_deg(error, 0 * error, torch.tensor([[0.9, 0.3]])).item() == pytest.approx(10, abs=1e-5)
    assert aolp_error_deg(error, 0 * error, torch.tensor([[0.9, 0.0]])).item() == 0
    zero = torch.zeros(2, 3, 3)
    assert aolp_error_deg(zero, zero, zero).tolist() == [45.0, 45.0]
    random = torch.rand(1, 300, 300, generator=torch.Generator().manual_seed(0)) * torch.pi
    assert aolp_error_deg(random, torch.zeros(1, 300, 300), torch.ones(1, 300, 300)).item() == pytest.approx(
        45, abs=0.3
    )


def test_masked_scores_are_those_of_the_valid_pixels(pair):
    a, b = pair
    valid = torch.ones(2, 24, 31, dtype=torch.bool)
    valid[:, :, 20:] = False
    spoilt = torch.where(valid, a, 7.0)
    known, other = a[..., :20], b[..., :20]
    torch.testing.assert_close(gradient_agreement(spoilt, b, valid), gradient_agreement(known, other))
    torch.testing.assert_close(aolp_error_deg(spoilt, b, b, valid), aolp_error_deg(known, other, other))
    torch.testing.assert_close(spread_mse(spoilt, valid), spread_mse(known))
    # scikit-image's map, which it makes in its own way; the frames agree where they are masked.
    truth, other = pair
    valid = torch.zeros(24, 31, dtype=torch.bool)
    valid[6:12, 8:20] = True
    mixed = torch.where(valid, other, truth)
    for a, b, masked in zip(mixed, truth, ssim(mixed, truth, valid.expand(2, -1, -1)), strict=True):
        options = {"data_range": 1.0, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
        _, whole = structural_similarity(a.numpy(), b.numpy(), full=True, **options)
        assert masked.item() == pytest.approx(float(whole[valid.numpy()].mean()), abs=1e-5)


PIXELWISE = [mse, level_mse, pattern_mse, psnr, correlation]


@pytest.mark.parametrize("metric", [*PIXELWISE, ssim])
def test_only_valid_pixels_count_and_a_mask_of_nothing_leaves_no_number(pair, metric):
    predicted, truth = pair
    valid = torch.zeros(2, 24, 31, dtype=torch.bool)
    valid[:, 3:20, 5:30] = True
    spoilt = torch.where(valid, predicted, 1 - predicted)
    assert not torch.equal(metric(spoilt, truth), metric(predicted, truth))
    masked = metric(spoilt, truth, valid)
    assert torch.equal(masked, metric(predicted, truth, valid))
    if metric is not ssim:  # whose kernels reach over the edge
        torch.testing.assert_close(masked, metric(*(x[:, 3:20, 5:30] for x in pair)), rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(metric(*pair, torch.ones_like(valid)), metric(*pair))
    assert metric(*pair, torch.zeros_like(valid)).isnan().all()


@pytest.mark.parametrize("metric", [mse, psnr, ssim, correlation, gradient_agreement, level_mse, pattern_mse])
def test_numpy_gives_what_torch_gives_and_leading_axes_are_kept(pair, metric):
    a, b = pair
    valid = b > 0.2
    assert torch.equal(metric(a.numpy(), b.numpy()), metric(a, b))
    assert torch.equal(metric(a.numpy(), b.numpy(), valid.numpy()), metric(a, b, valid))
    assert metric(a.view(1, 2, 24, 31), b.view(1, 2, 24, 31)).shape == (1, 2)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_a_truth_of_another_data_range_is_refused(pair, metric):
    a, b = pair
    with pytest.raises(ValueError, match=r"b: expected frames in \[0, 1\], got values up to 255; divide by 255"):
        metric(255 * a, 255 * b / b.max())
    metric(3 * a, b)  # a prediction may exceed it
    metric(a, torch.where(a > 0.5, 255, b), a <= 0.5)  # so may what nobody looks at


@pytest.mark.parametrize("metric", [mse, psnr, ssim, correlation, gradient_agreement, level_mse, pattern_mse])
def test_frames_of_bytes_or_of_different_shapes_are_refused(unchecked_annotations, pair, metric):
    a, b = pair
    with pytest.raises(ValueError, match=r"a: expected floating-point numbers, got torch\.uint8; divide by 255"):
        metric((255 * a).byte(), b)
    with pytest.raises(ValueError, match=r"expected a and b of one shape, got a \(2, 24, 31\), b \(24, 31\)"):
        metric(a, b[0])
    with pytest.raises(ValueError, match="valid: expected a mask, bool of shape"):
        metric(a, b, b)


def test_a_slope_below_a_tenth_of_a_stored_step_per_pixel_is_no_edge_on_any_shape_of_frame():
    """A tenth of a step is 1e-6: a ramp of 0.9e-6 a pixel is flat, and one of 1.1e-6 is not."""
    for slope, agreement in ((0.9e-6, 0.0), (1.1e-6, 1.0)):
        ramp = (slope * torch.arange(12, dtype=torch.float64)).expand(4, 12)
        for frame in (ramp, ramp.T):
            assert gradient_agreement(frame, frame).item() == pytest.approx(agreement)


def test_each_frame_has_its_scores_and_an_angle_if_the_method_predicts_one():
    dolp, offsets = torch.full((3, 8, 8), 0.5), torch.tensor([0.4, 0.2, 0.1]).view(3, 1, 1)
    scores = frame_scores(Prediction(dolp + offsets), dolp, dolp)
    assert scores["mse"].tolist() == pytest.approx([0.16, 0.04, 0.01], abs=1e-6)
    assert "aolp_deg" not in scores
    turned = Prediction(dolp, aolp=dolp + math.radians(10))
    assert frame_scores(turned, dolp, dolp)["aolp_deg"].tolist() == pytest.approx([10, 10, 10], abs=1e-4)


def test_errors_of_the_predicted_size_lie_on_the_diagonal_and_sequences_add_up():
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
    truth, valid = torch.zeros(1, 1, 2), torch.tensor([[[True, False]]])
    one = reliability(torch.tensor([[[-2.2, -2.2]]]), truth + 0.5, truth, valid)
    two = reliability(torch.tensor([[[-30.0, 5.0]]]), truth + 0.5, truth)
    together = one + two
    assert together.pixels.sum() == 3
    assert together.pixels[0] == together.pixels[BINS - 1] == 1
    assert together.measured.sum() == 0.75
    with pytest.raises(ValueError, match="needs pixels"):
        reliability(truth, truth, truth, torch.zeros_like(truth, dtype=torch.bool)).log_error()


def test_errors_four_times_as_large_as_expected_are_off_by_ln_4_and_a_bin_spans_half_a_unit():
    log_variance = torch.full((1, 2, 2), math.log(0.01))
    truth = torch.zeros(1, 2, 2)
    result = reliability(log_variance, truth + 0.2, truth)
    assert result.curve() == [pytest.approx((0.01, 0.04, 4))]
    assert result.log_error() == pytest.approx(math.log(4), rel=1e-5)
    log_variance = torch.tensor([[[-11.8, -11.3, -6.2, -0.2]]])
    result = reliability(log_variance, torch.zeros(1, 1, 4), torch.ones(1, 1, 4))
    assert result.pixels.nonzero().flatten().tolist() == [0, 1, 11, 23]
    assert len(result.pixels) == 24
