import pytest
import torch

from polarnet.metrics.lpips import Lpips
from polarnet.metrics.similarity import ssim
from polarnet.training.engine.losses import Loss, LossConfig, frame_terms, polarization_loss


def frames(value: float) -> torch.Tensor:
    return torch.full((2, 3, 12, 12), value)


def test_constant_frames_half_apart_and_a_loss_of_nothing_or_without_its_network():
    terms = Loss(frame_terms({"mse": 1.0, "mae": 1.0, "ssim_loss": 1.0}, None))(frames(0.25), frames(0.75))
    assert terms["mse"].item() == 0.25
    assert terms["mae"].item() == 0.5
    luminance = (2 * 0.25 * 0.75 + 0.01**2) / (0.25**2 + 0.75**2 + 0.01**2)  # all that SSIM sees of constants
    assert terms["ssim_loss"].item() == pytest.approx(1 - luminance, rel=1e-5)
    with pytest.raises(ValueError, match=r"lpips: its weight is 10.0, but there is no LPIPS network"):
        of_dolp(1.0, 1.0, 10.0)
    with pytest.raises(ValueError, match="mse, ssim, lpips: expected at least one weight > 0"):
        of_dolp(0.0, 0.0, 0.0)


def of_dolp(mse: float, ssim: float, lpips: float, network: Lpips | None = None) -> Loss:
    config = LossConfig(mse=mse, ssim=ssim, lpips=lpips, stokes=1.0, half_weight=None)
    return polarization_loss(config, network, dolp_only=True)


def test_the_total_is_equation_9_with_lpips_where_there_is_a_network():
    torch.manual_seed(0)
    lpips = Lpips("vgg")
    predicted, truth = torch.rand(2, 1, 2, 1, 32, 32).unbind()
    a, b = predicted[0, :, 0], truth[0, :, 0]
    plain = 2 * (a - b).square().mean() + 3 * (1 - ssim(a, b)).mean()
    for weight, expected in ((0.0, plain), (10.0, plain + 10 * lpips(a, b).mean())):
        loss = of_dolp(2.0, 3.0, weight, lpips)
        torch.testing.assert_close(loss.total(loss(predicted, truth)), expected)
    assert of_dolp(1.0, 1.0, 0.0).weights == {"mse": 1.0, "ssim_loss": 1.0}


def of_everything(dolp: float, s1: float, s2: float) -> torch.Tensor:
    return torch.tensor([dolp, s1, s2])[None, None, :, None, None].expand(2, 3, 3, 12, 12)


def test_angles_are_judged_where_a_network_predicts_them_at_valid_pixels():
    config = LossConfig(mse=1.0, ssim=0.0, lpips=0.0, stokes=2.0, half_weight=None)
    loss = polarization_loss(config, None, dolp_only=False)
    predicted, truth = of_everything(0.5, 0.3, 0.4), of_everything(0.4, 0.1, 0.4)
    terms = loss(predicted, truth)
    assert {name: round(term.item(), 5) for name, term in terms.items()} == {"mse": 0.01, "stokes": 0.04}
    assert loss.total(terms).item() == pytest.approx(0.01 + 2 * 0.04)
    valid = torch.zeros(2, 3, 12, 12, dtype=torch.bool)
    valid[..., :6] = True
    terms = loss(predicted, torch.where(valid[:, :, None], predicted, 0.9), valid)
    assert [term.item() for term in terms.values()] == [0, 0]


def of_two_frames(half_weight: float | None) -> tuple[Loss, torch.Tensor, torch.Tensor]:
    """A loss, and predictions and truths of an unpolarized frame and of one with a mean squared DoLP of 0.25."""
    config = LossConfig(mse=2.0, ssim=0.0, lpips=0.0, stokes=3.0, half_weight=half_weight)
    truth = torch.stack([of_everything(0.0, 0.0, 0.0)[0, 0], of_everything(0.5, 0.3, 0.4)[0, 0]])[:, None]
    return (polarization_loss(config, None, dolp_only=False), truth + torch.tensor([0.1, 0.2, 0])[:, None, None], truth)


def test_with_a_half_weight_polarized_frames_count_half_and_masked_ones_not_at_all():
    plain, predicted, truth = of_two_frames(half_weight=None)
    relative, _, _ = of_two_frames(half_weight=0.25)
    shares = (1 + 0.5) / 2  # of the unpolarized and the polarized frame
    terms = relative(predicted, truth)
    assert [*terms] == [*relative.weights]  # the loop names terms by their order
    assert {name: round(term.item(), 6) for name, term in terms.items()} == {
        "relative_mse": round(shares * 0.01, 6), "relative_stokes": round(shares * 0.04, 6),
    }  # fmt: skip
    torch.testing.assert_close(relative.total(terms), shares * plain.total(plain(predicted, truth)))
    relative, predicted, truth = of_two_frames(half_weight=0.25)
    predicted = predicted.clone().requires_grad_()
    valid = torch.ones(2, 1, 12, 12, dtype=torch.bool)
    valid[1] = False
    terms = relative(predicted, truth, valid)
    assert terms["relative_mse"].item() == pytest.approx(0.01)
    relative.total(terms).backward()
    assert predicted.grad is not None
    assert predicted.grad[0].any()
    assert predicted.grad.isfinite().all()
    assert not predicted.grad[1].any()


def test_masked_pixels_and_frames_count_in_no_term_and_get_no_gradient():
    torch.manual_seed(0)
    lpips = Lpips("vgg")
    loss = Loss(frame_terms({"mse": 1.0, "mae": 1.0, "ssim_loss": 1.0, "lpips": 1.0}, lpips))
    truth = torch.rand(2, 2, 32, 32)
    predicted = torch.rand(2, 2, 32, 32, requires_grad=True)
    valid = torch.rand(2, 2, 32, 32) < 0.8
    valid[1, 1] = False
    terms = loss(predicted, truth, valid)
    spoilt = torch.where(valid, predicted, 1 - predicted)
    assert all(torch.equal(terms[name], term) for name, term in loss(spoilt, truth, valid).items())
    of_three = [p[v] - t[v] for p, t, v in zip(*(x.flatten(0, 1)[:3] for x in (predicted, truth, valid)), strict=True)]
    torch.testing.assert_close(terms["mse"], torch.stack([d.square().mean() for d in of_three]).mean())
    torch.testing.assert_close(terms["mae"], torch.stack([d.abs().mean() for d in of_three]).mean())
    loss.total(terms).backward()
    assert (predicted.grad[~valid] == 0).all()
    assert (predicted.grad[valid] != 0).float().mean() > 0.99
