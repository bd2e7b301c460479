"""Recurrent networks that predict DoLP from the events of a window, as methods."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from polarnet.events.representations import REPRESENTATIONS, Encode
from polarnet.events.streaming import EventWindow
from polarnet.methods.method import Recoverer, Setup, State, each_map, weights_file
from polarnet.networks.checkpoint import load_network
from polarnet.networks.registry import NETWORKS
from polarnet.stokes import Prediction

DOLP_NETWORKS = tuple(NETWORKS)


def encoded(windows: Sequence[EventWindow], encode: Encode) -> Float[Tensor, "n c h w"]:
    """Encode every window, with the channels concatenated along the second axis."""
    return torch.stack([_encoded(window, encode) for window in windows])


def dolp_recoverer(
    network: nn.Module, metadata: Mapping[str, Any], device: torch.device | str = "cpu", precision: str = "fp32"
) -> Recoverer:
    """Wrap a network and the metadata of its checkpoint (`load_network`) as a method.

    `precision` is fp32 or bf16 (autocast). Windows should be as long as in training. For DoLP at a higher rate, let
    windows of that length overlap (`polarnet.methods.overlap`).
    """
    place = torch.device(device)
    ready: Any = network.to(place, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
    encode = REPRESENTATIONS[metadata["representation"]]

    def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        inputs = encoded(windows, encode)[:, None].to(place)
        with torch.autocast(place.type, torch.bfloat16, enabled=precision == "bf16"):
            prediction, state = ready.unroll(inputs, state)
        return state, each_map(prediction, lambda field: field[:, 0])

    return Recoverer(lambda height, width: None, predict, network=ready)


def open_dolp_network(setup: Setup) -> Recoverer:
    """Open the DoLP network from the checkpoint in the setup."""
    network, metadata = load_network(weights_file(setup))
    return dolp_recoverer(network, metadata, setup.device, setup.precision)


def _encoded(window: EventWindow, encode: Encode) -> Float[Tensor, "c h w"]:
    images = [encode(events, window.length_us) for events in window.channels]
    return torch.cat([image.view(-1, *image.shape[-2:]) for image in images])
