import copy

import pytest
import torch
from torch import nn

from polarnet.training.engine.optimizers import OPTIMIZERS

RATE = 0.01


class Small(nn.Module):
    outputs = ("last",)

    def __init__(self):
        super().__init__()
        self.hidden = nn.Conv2d(3, 8, kernel_size=3)
        self.last = nn.Conv2d(8, 4, kernel_size=1)
        self.unused = nn.Conv2d(2, 2, kernel_size=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(torch.tanh(self.hidden(x)))


def small() -> nn.Module:
    torch.manual_seed(0)
    return Small().to(memory_format=torch.channels_last)


def stepped(network: nn.Module, optimizer, steps: int = 1) -> dict[str, torch.Tensor]:
    """By how much the weights have changed after so many steps towards zero outputs."""
    before = {name: weight.detach().clone() for name, weight in network.named_parameters()}
    x = torch.randn(2, 3, 9, 9, generator=torch.Generator().manual_seed(1))
    for _ in range(steps):
        network.zero_grad()
        network(x).square().mean().backward()
        optimizer.step()
    return {name: (weight - before[name]).detach() for name, weight in network.named_parameters()}


def test_muon_moves_hidden_layers_in_all_directions_alike_and_the_rest_as_adam_does():
    (muon, adam) = (small(), small())
    by_muon, by_adam = (stepped(n, OPTIMIZERS[o](n, RATE)) for n, o in ((muon, "muon"), (adam, "adam")))
    for name in ("hidden.bias", "last.weight", "last.bias"):
        torch.testing.assert_close(by_muon[name], by_adam[name])
        assert by_muon[name].any()
    values = torch.linalg.svdvals(by_muon["hidden.weight"].flatten(1))
    assert values.min() > 0.5 * values.max()
    values = torch.linalg.svdvals(by_adam["hidden.weight"].flatten(1))
    assert values.min() < 0.3 * values.max()
    root_mean_square = by_muon["hidden.weight"].square().mean().sqrt()
    assert root_mean_square == pytest.approx(0.2 * RATE, rel=0.5)
    assert not by_muon["unused.weight"].any()


@pytest.mark.parametrize("name", sorted(OPTIMIZERS))
def test_what_an_optimizer_remembers_can_be_kept_and_its_rate_set(name):
    network = small()
    optimizer = OPTIMIZERS[name](network, RATE)
    stepped(network, optimizer, steps=3)
    other = small()
    other.load_state_dict(network.state_dict())
    resumed = OPTIMIZERS[name](other, 1.0)
    resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    expected = stepped(network, optimizer, steps=2)
    for name, change in stepped(other, resumed, steps=2).items():
        assert torch.equal(change, expected[name]), name
    for group in resumed.param_groups:
        group["lr"] = 0.0  # as the loop sets it
    assert not any(change.any() for change in stepped(other, resumed).values())
