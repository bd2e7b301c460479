"""Base class of recurrent networks that others published, and the layers of FireNet, which E2P and E2VID share."""

import os
import pickle
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

Network = TypeVar("Network", bound="PublishedNetwork")


class PublishedNetwork(nn.Module):
    """Recurrent network that takes voxel grids of `bins` bins and passes its state from window to window."""

    label: ClassVar[str]
    """Name of the network in error messages."""
    first_layer: ClassVar[str]
    """Name of the first layer's weight, whose second axis has one entry per bin."""

    def __init__(self, bins: int):
        super().__init__()
        self.bins = bins

    def unroll(
        self, windows: Float[Tensor, "t b bins h w"], state: Any = None
    ) -> tuple[Float[Tensor, "t b *k i j"], Any]:
        """Process t windows of b streams, one window after the other; `state` is None at the start."""
        frames = []
        for window in windows:
            frame, state = self(window, state)
            frames.append(frame)
        return torch.stack(frames), state or []

    @classmethod
    def load(cls: type[Network], path: str | os.PathLike[str]) -> Network:
        """Load a published file without running code from it; ValueError if it belongs to another network."""
        content = read_content(path)
        content = content if isinstance(content, dict) else {}
        tensors = cls.own_names(content.get("state_dict", content))
        first = tensors.get(cls.first_layer)
        if first is None:
            raise ValueError(f"{path} holds no {cls.label}: expected a tensor {cls.first_layer}")
        network = cls(bins=first.shape[1], **cls.variant(tensors))
        try:
            network.load_state_dict(tensors)
        except RuntimeError as error:
            raise ValueError(f"{path} holds no {cls.label}: expected tensors of the published size: {error}") from None
        return network.eval()

    @classmethod
    def variant(cls, tensors: Mapping[str, Tensor]) -> dict[str, Any]:
        """Constructor arguments besides `bins`, for networks that were published in several variants."""
        return {}

    @classmethod
    def own_names(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Tensors by the names of this class, which are the authors' unless a subclass renames them."""
        return dict(tensors)


def read_content(path: str | os.PathLike[str]) -> Any:
    """Load a torch file, with empty objects for those of the authors' code; ValueError if torch cannot read it."""
    try:
        unknown = torch.serialization.get_unsafe_globals_in_checkpoint(path)
    except (ValueError, RuntimeError):  # files older than torch's zip format, which hold no such objects
        unknown = []
    ignoring = {"__init__": lambda self, *arguments: None, "__setstate__": lambda self, state: None}
    inert: list[Any] = [(type(name.rpartition(".")[2], (), ignoring), name) for name in unknown]
    try:
        with torch.serialization.safe_globals(inert):
            return torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        raise ValueError(f"{path} is not a file of weights that torch can read: {str(error)[:200]}") from None


class ConvGRU(nn.Module):
    """FireNet's convolutional gated recurrent unit, under the authors' names.

    reset, update = sigmoid(conv[x, h]);  candidate = tanh(conv[x, reset * h]);  h <- h + update * (candidate - h).
    """

    def __init__(self, channels: int):
        super().__init__()
        self.reset_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.update_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.out_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)

    def forward(self, x: Float[Tensor, "b c h w"], state: Float[Tensor, "b c h w"] | None) -> Float[Tensor, "b c h w"]:
        """Return the new state; a `state` of None (at the start) counts as zeros."""
        state = torch.zeros_like(x) if state is None else state.to(x.dtype)
        both = torch.cat([x, state], dim=1)
        reset, update = self.reset_gate(both).sigmoid_(), self.update_gate(both).sigmoid_()
        candidate = self.out_gate(torch.cat([x, reset * state], dim=1)).tanh_()
        return torch.lerp(state, candidate, update)


class ResidualBlock(nn.Module):
    """FireNet's residual block relu(x + conv(relu(conv(x)))); E2VID's has batch normalisation after each conv."""

    def __init__(self, channels: int, normalised: bool = False):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1, bias=not normalised)
        self.bn1 = nn.BatchNorm2d(channels) if normalised else nn.Identity()
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=not normalised)
        self.bn2 = nn.BatchNorm2d(channels) if normalised else nn.Identity()

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Return a tensor of the same shape."""
        return self.bn2(self.conv2(self.bn1(self.conv1(x)).relu_())).add_(x).relu_()
