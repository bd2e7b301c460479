"""Optimizers by their names in params.yaml."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Adam, Optimizer


class Muon(Optimizer):
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
        self._weights = [weight for name, weight in named if name in hidden]
        self._matrices: list[Tensor] = [nn.Parameter(weight.detach().flatten(1).clone()) for weight in self._weights]
        self._others = [weight for name, weight in named if name not in hidden]
        self._muon = torch.optim.Muon(
            self._matrices, lr=learning_rate, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"
        )
        self._adam = Adam(self._others, lr=learning_rate, fused=True)
        super().__init__([*self._matrices, *self._others], {"lr": learning_rate})
        self._share_groups()

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Reset the gradients of the network's weights."""
        for weight in (*self._weights, *self._others):
            if set_to_none:
                weight.grad = None
            elif weight.grad is not None:
                weight.grad.zero_()

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update the weights that have gradients; there is no `closure`."""
        self._adam.step()
        for matrix, weight in self._pairs():
            matrix.copy_(weight.flatten(1))
            matrix.grad = None if weight.grad is None else weight.grad.flatten(1)
        self._muon.step()
        for matrix, weight in self._pairs():
            weight.copy_(matrix.view(weight.shape))

    def state_dict(self) -> dict[str, Any]:
        """Return the state of both optimizers."""
        return {"muon": self._muon.state_dict(), "adam": self._adam.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state of both optimizers."""
        self._muon.load_state_dict(state_dict["muon"])
        self._adam.load_state_dict(state_dict["adam"])
        self._share_groups()

    def _share_groups(self) -> None:
        """Let a learning rate that is set here, as by torch's schedulers, hold in both optimizers."""
        self.param_groups = [*self._muon.param_groups, *self._adam.param_groups]

    def _pairs(self) -> Iterator[tuple[Tensor, Tensor]]:
        return zip(self._matrices, self._weights, strict=True)


def _adam(network: nn.Module, learning_rate: float) -> Optimizer:
    return Adam(network.parameters(), lr=learning_rate, fused=True)


OPTIMIZERS: dict[str, Callable[[nn.Module, float], Optimizer]] = {"adam": _adam, "muon": Muon}
"""Functions that build an optimizer from a network and a learning rate."""
