"""Optimizers by their names in params.yaml."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn


class Muon:
    """Muon for the weights of hidden layers, Adam for everything else, as recommended by Jordan et al. (2024).

    Muon steps along the orthogonalised momentum of the gradient, so all directions of a layer's matrix move equally;
    Adam's steps are dominated by a few directions. `torch.optim.Muon` accepts only matrices, so a convolution's weight
    is flattened to (outputs, everything else). Muon's steps are about as long as Adam's (`match_rms_adamw`), so both
    share one learning rate. Adam also trains the layers that the network lists in `outputs`, because their results are
    read as numbers.
    """

    def __init__(self, network: nn.Module, learning_rate: float):
        outputs = tuple(f"{name}." for name in getattr(network, "outputs", ()))
        named = list(network.named_parameters())
        hidden = {name for name, weight in named if weight.ndim > 1 and not name.startswith(outputs)}
        self._weights = [weight for name, weight in named if name in hidden]
        self._matrices = [nn.Parameter(weight.detach().flatten(1).clone()) for weight in self._weights]
        others = [weight for name, weight in named if name not in hidden]
        self._muon = torch.optim.Muon(
            self._matrices, lr=learning_rate, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"
        )
        self._adam = torch.optim.Adam(others, lr=learning_rate, fused=True)
        self.zero_grad = network.zero_grad

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        """Parameter groups of both optimizers; the loop sets their learning rate `lr`."""
        return [*self._muon.param_groups, *self._adam.param_groups]

    @torch.no_grad()
    def step(self) -> None:
        """Update the weights that have gradients."""
        for matrix, weight in self._pairs():
            matrix.copy_(weight.flatten(1))
            matrix.grad = None if weight.grad is None else weight.grad.flatten(1)
        self._muon.step()
        self._adam.step()
        for matrix, weight in self._pairs():
            weight.copy_(matrix.view(weight.shape))

    def state_dict(self) -> dict[str, Any]:
        """Return the state of both optimizers."""
        return {"muon": self._muon.state_dict(), "adam": self._adam.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state of both optimizers."""
        self._muon.load_state_dict(state_dict["muon"])
        self._adam.load_state_dict(state_dict["adam"])

    def _pairs(self) -> Iterator[tuple[Tensor, Tensor]]:
        return zip(self._matrices, self._weights, strict=True)


Stepper = torch.optim.Optimizer | Muon


def _adam(network: nn.Module, learning_rate: float) -> Stepper:
    return torch.optim.Adam(network.parameters(), lr=learning_rate, fused=True)


OPTIMIZERS: dict[str, Callable[[nn.Module, float], Stepper]] = {"adam": _adam, "muon": Muon}
"""Functions that build an optimizer from a network and a learning rate."""
