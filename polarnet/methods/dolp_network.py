"""Recurrent networks that predict DoLP from the events of a window, as methods."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import Field, PositiveFloat
from torch import Tensor, nn

from polarnet.events.representations import REPRESENTATIONS, Encode, event_counts
from polarnet.events.stream import Events
from polarnet.events.streaming import EventWindow
from polarnet.methods.method import Recoverer, Setup, State, each_map, weights_file, windows_at_once
from polarnet.methods.window_length import of_any_length
from polarnet.networks.base.checkpoint import trained_window_us
from polarnet.networks.polarnet.stokes_unet import MAX_BINNING, Binning, StokesUNet
from polarnet.networks.registry import NETWORKS, load_network
from polarnet.runtime.sections import section
from polarnet.stokes import Prediction

DOLP_NETWORKS = tuple(NETWORKS)


@section
class DolpNetworkConfig:
    """Section `methods.ours` of params.yaml."""

    thresholds: Annotated[list[PositiveFloat], Field(min_length=2, max_length=2)] | None
    """Contrast thresholds of the camera, ON and OFF, in natural-log intensity; null: estimated from the events."""
    binning: Binning | None
    """Side in pixels of the blocks that the network sees (`networks.polarnet.binning`); null: as in its training."""


def encoded(windows: Sequence[EventWindow], encode: Encode) -> Float[Tensor, "n c h w"]:
    """Encode every window, with the channels concatenated along the second axis."""
    return torch.stack([_encoded(window, encode) for window in windows])


def dolp_recoverer(
    network: nn.Module,
    metadata: Mapping[str, Any],
    device: torch.device | str = "cpu",
    precision: str = "fp32",
    thresholds: Sequence[float] | None = None,
    binning: int | None = None,
) -> Recoverer:
    """Wrap a network and the metadata of its checkpoint (`load_network`) as a method.

    `precision` is fp32 or bf16 (autocast). Windows may have any length. `thresholds` are the camera's contrast thresholds,
    ON and OFF (`told`), and `binning` is the side of the pixel blocks that the network sees (default: that of its
    training).
    """
    place = torch.device(device)
    ready: Any = network.to(place, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
    encode = REPRESENTATIONS[metadata["representation"]]
    if thresholds is not None:
        encode = told(ready, metadata, thresholds)
    if binning is not None:
        _bin(ready, metadata, binning)

    def autocast() -> torch.autocast:
        return torch.autocast(place.type, torch.bfloat16, enabled=precision == "bf16")

    def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        with autocast():
            prediction, state = ready.unroll(encoded(windows, encode)[:, None].to(place), state)
        return state, each_map(prediction, lambda field: field[:, 0])

    def at_once(height: int, width: int) -> int:
        side = ready.binning if isinstance(ready, StokesUNet) else 1
        return windows_at_once(height // side, width // side)

    recoverer = Recoverer(lambda height, width: None, predict, network=ready, at_once=at_once)
    trained_us = trained_window_us(metadata)
    return recoverer if trained_us is None else of_any_length(recoverer, trained_us)


def open_dolp_network(setup: Setup) -> Recoverer:
    """Open the DoLP network from the checkpoint in the setup."""
    network, metadata = load_network(weights_file(setup))
    options = (setup.config.thresholds, setup.config.binning) if isinstance(setup.config, DolpNetworkConfig) else ()
    return dolp_recoverer(network, metadata, setup.device, setup.precision, *options)


def told(network: nn.Module, metadata: Mapping[str, Any], thresholds: Sequence[float]) -> Encode:
    """Tell a network the camera's contrast thresholds (ON, OFF), and return the encoding of events that it then needs.

    The network uses their geometric mean instead of its own estimate, and each event counts as its threshold over this
    mean. ValueError if a threshold is not above 0, or for a network that estimates no threshold.
    """
    if min(thresholds) <= 0:
        raise ValueError(f"thresholds: expected numbers above 0 (ON, OFF), got {list(thresholds)}")
    mean = math.sqrt(math.prod(thresholds))
    unet = _stokes_unet(network, metadata, "thresholds")
    unet.scale.given = mean / unet.step
    return weighted_counts([threshold / mean for threshold in thresholds])


def _bin(network: nn.Module, metadata: Mapping[str, Any], side: int) -> None:
    if not 1 <= side <= MAX_BINNING:
        raise ValueError(f"binning: expected blocks with a side of 1 to {MAX_BINNING} px, got {side}")
    _stokes_unet(network, metadata, "binning").binning = side


def _stokes_unet(network: nn.Module, metadata: Mapping[str, Any], option: str) -> StokesUNet:
    """Return the network if it is polarnet's own, which alone has this option; ValueError for another network."""
    if not isinstance(network, StokesUNet):
        raise ValueError(f"{option}: expected network polarnet, got {metadata['network']}; leave {option} out")
    return network


def weighted_counts(steps: Sequence[float]) -> Encode:
    """Return an encoding like `event_counts`, in which an ON event counts steps[0] and an OFF event steps[1]."""

    def encode(events: Events, window_us: int) -> Float[Tensor, "2 h w"]:
        polarity, count = event_counts(events, window_us)
        on, off = steps[0] * (count + polarity) / 2, steps[1] * (count - polarity) / 2
        return torch.stack([on - off, on + off])

    return encode


def _encoded(window: EventWindow, encode: Encode) -> Float[Tensor, "c h w"]:
    images = [encode(events, window.length_us) for events in window.channels]
    return torch.cat([image.view(-1, *image.shape[-2:]) for image in images])
