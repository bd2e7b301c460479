"""What delays say, on signals whose delays are known."""

import math

import torch

from polarnet.networks.delays import Delays, delay_products

PARTS = 400


def changes(of: list[float], seed: int = 0) -> torch.Tensor:
    """Changes of four polarizers in each part, of a random course that polarizer k shows `of[k]` parts later."""
    torch.manual_seed(seed)
    frequency, phase = torch.rand(2, 40, 8, 8)
    t = torch.arange(PARTS + 1).view(-1, 1, 1, 1)

    def course(delay: float) -> torch.Tensor:
        return torch.sin((0.1 + 1.5 * frequency) * (t - delay) + 2 * math.pi * phase).sum(1)

    return torch.stack([course(delay) for delay in of], dim=1)[:, None].diff(dim=0)


def told(parts: torch.Tensor) -> torch.Tensor:
    """The delays of A and of B against the mean of the four, in mean squares of the mean."""
    of_a, of_b, energy = delay_products(parts, pooled=8)[0, :, 0, 0]
    return torch.stack([of_a, of_b]) / energy


def test_the_polarizer_that_is_late_is_told_and_by_how_much():
    late = told(changes([0.0, 0.1, 0.2, 0.1]))
    assert late[0] > 0.05
    assert abs(late[1]) < 0.1 * late[0]
    torch.testing.assert_close(told(changes([0.2, 0.1, 0.0, 0.1])), -late, atol=0.01, rtol=0)
    torch.testing.assert_close(told(changes([0.0, 0.1, 0.4, 0.1]))[0], 2 * late[0], atol=0, rtol=0.15)


def test_a_weaker_answer_is_no_delay():
    weaker = changes([0.0] * 4) * torch.tensor([1.0, 0.8, 0.5, 0.8]).view(1, 1, 4, 1, 1)
    assert told(weaker).abs().max() < 0.01


def test_delays_are_believed_where_polarizers_hardly_differ():
    delays = Delays(memories=2, decays=1, scales=1)
    products = torch.tensor([0.1, -0.05, 1.0]).view(1, 1, 1, 3, 1, 1)
    moments = torch.zeros(2, 2, 1, 1, 6, 1, 1)
    moments[..., 5, :, :] = 1.0
    moments[1, :, :, :, 0] = 1.0  # A varies
    s1, s2, logit = delays(products.expand(2, 1, 1, 3, 1, 1), moments)
    assert s1.min() > 0
    torch.testing.assert_close(s2, -s1 / 2)
    assert logit[0] > 4
    assert logit[1] < -2


def test_nothing_seen_says_nothing():
    s1, s2, logit = Delays(memories=1, decays=2, scales=1)(
        torch.zeros(1, 2, 1, 3, 4, 4), torch.zeros(1, 1, 2, 1, 6, 4, 4)
    )
    assert s1.shape == s2.shape == logit.shape == (1, 2, 4, 4)
    assert not s1.any()
    assert not s2.any()
    assert logit.isfinite().all()
