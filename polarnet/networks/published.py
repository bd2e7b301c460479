"""Base of the recurrent networks with published weights: one window after another, and files of their authors."""

import os
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

Network = TypeVar("Network", bound="PublishedNetwork")


class PublishedNetwork(nn.Module):
    """Recurrent network that takes voxel grids of `bins` bins and passes its state from window to window."""

    label: ClassVar[str]
    """Name of the network in errors."""
    first_layer: ClassVar[str]
    """Weight of the first layer, whose second axis is the bins."""

    def __init__(self, bins: int):
        super().__init__()
        self.bins = bins

    def check_bins(self, voxels: Float[Tensor, "b bins h w"]) -> None:
        """Raise ValueError for a grid with another number of bins."""
        if voxels.shape[1] != self.bins:
            raise ValueError(f"this {self.label} takes {self.bins} bins, got {voxels.shape[1]}")

    def unroll(
        self, windows: Float[Tensor, "t b bins h w"], state: Any = None
    ) -> tuple[Float[Tensor, "t b *k i j"], list[Tensor]]:
        """Process t windows of b streams, one window after the other; `state` is None at the start."""
        frames = []
        for window in windows:
            frame, state = self(window, state)
            frames.append(frame)
        return torch.stack(frames), state or []

    @classmethod
    def load(cls: type[Network], path: str | os.PathLike[str]) -> Network:
        """Load a published file without running code from it; ValueError if it belongs to another network."""
        content = torch.load(path, map_location="cpu", weights_only=True)
        tensors = cls.own_names(cls.published_tensors(path, content if isinstance(content, dict) else {}))
        first = tensors.get(cls.first_layer)
        if first is None:
            raise ValueError(f"{path} holds no {cls.label}: expected a tensor {cls.first_layer}")
        network = cls(bins=first.shape[1])
        try:
            network.load_state_dict(tensors)
        except RuntimeError as error:
            raise ValueError(f"{path} holds no {cls.label}: expected tensors of the published size: {error}") from None
        return network.eval()

    @classmethod
    def published_tensors(cls, path: str | os.PathLike[str], content: Mapping[str, Any]) -> Mapping[str, Tensor]:
        """Tensors in the content of a published file, by the authors' names."""
        return content.get("state_dict", content)

    @classmethod
    def own_names(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Tensors by the names of this class, which are the authors' unless a subclass renames them."""
        return dict(tensors)
