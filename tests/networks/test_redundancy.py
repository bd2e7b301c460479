import math

import pytest
import torch

from polarnet.networks.base.blocks import contrasts
from polarnet.networks.polarnet.redundancy import (
    MOMENTS,
    LeastSquares,
    SecondMoments,
    SlopeMoments,
    faded,
    neighbourhoods,
)
from polarnet.stokes import intensities_from_stokes, stokes_from_polarization


def changes(dolp: float, aolp: float, count: int, size: float) -> torch.Tensor:
    """How much the four log intensities of `count` pixels change where light and polarization vary by about `size`."""
    torch.manual_seed(0)
    s0, degree, angle = torch.tensor([0.5, dolp, aolp]).double().view(3, 1, 1) + size * torch.randn(3, 2, count)
    before, after = intensities_from_stokes(stokes_from_polarization(s0, degree, angle)).log().unbind(1)
    return (after - before).float()


def noiseless(memories: int = 1) -> SecondMoments:
    moments = SecondMoments(memories)
    with torch.no_grad():
        for parameter in moments.parameters():
            parameter.fill_(-torch.inf)
    return moments


@pytest.mark.parametrize(("dolp", "aolp"), [(0.6, 0.3), (0.3, 2.0), (0.8, 1.2), (0.05, 0.0)])
@torch.no_grad()
def test_polarization_follows_from_small_changes_of_the_logarithms_and_from_slopes_but_for_constants(dolp, aolp):
    of_changes = noiseless()(1e4 * changes(dolp, aolp, 400, 1e-3).view(1, 1, 4, 1, 400), pooled=1)[:, 0]
    torch.manual_seed(0)
    s0, degree, angle = torch.tensor([0.5, dolp, aolp]).double().view(3, 1, 1) + 1e-3 * torch.randn(3, 20, 30)
    logs = intensities_from_stokes(stokes_from_polarization(s0, degree, angle)).log() + torch.randn(4, 1, 1)
    of_slopes = SlopeMoments()(1e3 * contrasts(logs.float()[None]))[:, :-1]
    solve = LeastSquares(1, 1, 1)
    solve.log_ridge.fill_(-torch.inf)
    for moments in (of_changes, of_slopes):
        s1, s2, _ = solve(moments.mean((-1, -2), keepdim=True)[:, None, None, None])
        assert s1.item() == pytest.approx(dolp * math.cos(2 * aolp), abs=0.02)
        assert s2.item() == pytest.approx(dolp * math.sin(2 * aolp), abs=0.02)


@torch.no_grad()
def test_moments_of_slopes_by_hand():
    moments = SlopeMoments()
    moments.log_activity.fill_(math.log(0.5))
    picture = torch.zeros(1, 4, 2, 2)
    picture[0, :, :, 1] = torch.tensor([1.0, 2.0, -1.0, 3.0]).view(4, 1)  # in both rows; nothing changes downwards
    weight = 1 / (1 + 0.5 * 15)  # of two of eight slopes of a block; the others' are 0 and weigh 1
    products = torch.tensor([4.0, -2, 1, 6, -3, 1, 15]) * weight * 2
    expected = (products + torch.tensor([0.0, 0, 0, 0, 0, 6, 0])) / 4
    torch.testing.assert_close(moments(picture).flatten(), expected)


@torch.no_grad()
def test_moments_by_hand():
    e0, e45, e90, e135 = 3.0, 1.0, -1.0, 2.0  # A = 4, B = -1, C = -1
    events = torch.tensor([e0, e45, e90, e135]).view(1, 1, 4, 1, 1)
    assert noiseless()(events, pooled=1).flatten().tolist() == [16, -4, 1, -4, 1, 7]
    noisy = SecondMoments(1)
    noisy.log_activity.fill_(math.log(0.2))
    noisy.log_mismatch.fill_(math.log(0.1))
    noisy.log_step.fill_(math.log(0.5))
    variance = [0.1 * e * e + 0.5 * abs(e) for e in (e0, e45, e90, e135)]  # 2.4, 0.6, 0.6, 1.4
    expected = [16 - 2.4 - 0.6, -4, 1 - 0.6 - 1.4, -4 - 2.4 + 0.6, 1 + 0.6 - 1.4, 7]
    assert variance == pytest.approx([2.4, 0.6, 0.6, 1.4])
    torch.testing.assert_close(noisy(events, pooled=1).flatten(), torch.tensor(expected) / (1 + 0.2 * 15))


@torch.no_grad()
def test_solutions_stay_physical_whatever_the_moments():
    torch.manual_seed(0)
    moments = 100 * torch.randn(5, 2, 3, 2, MOMENTS, 4, 4)
    moments[:, :, :, :, -1].abs_()  # a number of steps
    s1, s2, _ = LeastSquares(2, 3, 2)(moments)
    assert s1.shape == (5, 12, 4, 4)
    assert torch.hypot(s1, s2).max() <= 1 + 1e-5
    silent = SecondMoments(1)(torch.zeros(1, 1, 4, 2, 2), pooled=1)[:, :, None, None]
    assert not any(field.any() for field in LeastSquares(1, 1, 1)(silent))  # without events nothing is polarized


def test_running_sums_fade_and_neighbourhoods_are_means_inside_the_image():
    sums = faded(torch.tensor([[1.0], [1.0], [2.0]]), torch.tensor([0.5, 0.0]), torch.tensor([4.0, 4.0]))
    assert sums.tolist() == [[3.0, 1.0], [2.5, 1.0], [3.25, 2.0]]
    x = torch.arange(9.0).view(1, 1, 3, 3)
    one, three, everything = neighbourhoods(x, [1, 3, 0])
    assert torch.equal(one, x)
    assert three[0, 0, 0].tolist() == [2.0, 2.5, 3.0]
    assert everything.unique().tolist() == [4.0]
