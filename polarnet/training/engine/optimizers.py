"""Optimizers by their names in params.yaml."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Adam


class Muon:
    """Muon for the weights of hidden layers, Adam for everything else, as recommended by Jordan et al. (2024).

    Muon steps along the orthogonalised momentum of the gradient, so all directions of a layer's matrix move equally;
    Adam's steps are dominated by a few directions. `torch.optim.Muon` accepts only matrices, so a convolution's weight
    is flattened to (outputs, everything else). Muon's steps are about as long as Adam's (`match_rms_adamw`), so both
    share one learning rate. Adam also trains the layers that the network lists in `outputs`, because their results are
    used as quantities, not as features.
    """

    def __init__(self, network: nn.Module, learning_rate: float):
        outputs = tuple(f"{name}." for name in getattr(network, "outputs", ()))
        named = list(network.named_parameters())
        hidden = {name for name, weight in named if weight.ndim > 1 and not name.startswith(outputs)}
        weights = [weight for name, weight in named if name in hidden]
        matrices: list[Tensor] = [nn.Parameter(weight.detach().flatten(1).clone()) for weight in weights]
        self._pairs = list(zip(matrices, weights, strict=True))
        self._muon = torch.optim.Muon(matrices, lr=learning_rate, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
        self._adam = Adam([weight for name, weight in named if name not in hidden], lr=learning_rate, fused=True)

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        """Settings of both optimizers, whose `lr` the training loop sets."""
        return [*self._muon.param_groups, *self._adam.param_groups]

    @torch.no_grad()
    def step(self) -> None:
        """Update the weights that have gradients."""
        self._adam.step()
        for matrix, weight in self._pairs:
            matrix.copy_(weight.flatten(1))
            matrix.grad = None if weight.grad is None else weight.grad.flatten(1)
        self._muon.step()
        for matrix, weight in self._pairs:
            weight.copy_(matrix.view(weight.shape))

    def state_dict(self) -> dict[str, Any]:
        """Return the state of both optimizers."""
        return {"muon": self._muon.state_dict(), "adam": self._adam.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state of both optimizers."""
        self._muon.load_state_dict(state_dict["muon"])
        self._adam.load_state_dict(state_dict["adam"])


Optimizer = torch.optim.Optimizer | Muon


def _adam(network: nn.Module, learning_rate: float) -> Optimizer:
    return Adam(network.parameters(), lr=learning_rate, fused=True)


OPTIMIZERS: dict[str, Callable[[nn.Module, float], Optimizer]] = {"adam": _adam, "muon": Muon}
"""Functions that build an optimizer from a network and a learning rate."""
