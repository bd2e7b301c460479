"""Recurrent networks that predict DoLP from the events of a window, as methods: polarnet's, the paper's and E2P.

E2P (Mei et al., CVPR 2023) takes the four channels interleaved as a mosaic of twice the height and width.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import Field, PositiveFloat
from torch import Tensor, nn

from polarnet.events.representations import REPRESENTATIONS, Encode, event_counts, voxel_grid
from polarnet.events.stream import Events, join_mosaic
from polarnet.events.streaming import EventWindow
from polarnet.methods.intensity_networks import load_baseline, voxel_grids
from polarnet.methods.method import Method, Recoverer, Setup, each_map, network_recoverer, weights_file, windows_at_once
from polarnet.methods.overlap import of_any_length
from polarnet.networks.base.checkpoint import trained_window_us
from polarnet.networks.e2p.network import MOSAIC, E2p, angle_of, interleaved
from polarnet.networks.polarnet.stokes_unet import MAX_BINNING, Binning, StokesUNet
from polarnet.networks.registry import NETWORKS, load_network
from polarnet.runtime.sections import section
from polarnet.stokes import Prediction


@section
class DolpNetworkConfig:
    """Section `methods.ours` of params.yaml."""

    thresholds: Annotated[list[PositiveFloat], Field(min_length=2, max_length=2)] | None
    """Contrast thresholds of the camera, ON and OFF, in natural-log intensity; null: estimated from the events."""
    binning: Binning | None
    """Side in pixels of the blocks that the network sees (`networks.polarnet.binning`); null: as in its training."""


def dolp_recoverer(
    network: nn.Module,
    metadata: Mapping[str, Any],
    device: torch.device | str = "cpu",
    precision: str = "fp32",
    thresholds: Sequence[float] | None = None,
    binning: int | None = None,
) -> Recoverer:
    """Wrap a network and the metadata of its checkpoint (`load_network`) as a method for windows of any length.

    `precision` is fp32 or bf16 (autocast). `thresholds` (ON, OFF) replace the network's own estimate, and `binning`
    the side of the pixel blocks that it sees. The network itself moves to `device` and keeps these options. ValueError
    if one is given for another network than polarnet's, which alone has them, or is out of range.
    """
    place = torch.device(device)
    ready: Any = network.to(place, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
    for option, value in (("thresholds", thresholds), ("binning", binning)):
        if value is not None and not isinstance(ready, StokesUNet):
            raise ValueError(f"{option}: expected network polarnet, got {metadata['network']}; leave {option} out")
    encode = REPRESENTATIONS[metadata["representation"]]
    if binning is not None:
        if not 1 <= binning <= MAX_BINNING:
            raise ValueError(f"binning: expected blocks with a side of 1 to {MAX_BINNING} px, got {binning}")
        ready.binning = binning
    if thresholds is not None:
        if not all(0.001 <= threshold <= 10 for threshold in thresholds):
            raise ValueError(f"thresholds: expected 0.001 to 10 in log intensity (ON, OFF), got {list(thresholds)}")
        mean = math.sqrt(math.prod(thresholds))
        ready.scale.given = mean / ready.step
        encode = weighted_counts([threshold / mean for threshold in thresholds])

    def encoded(window: EventWindow) -> Float[Tensor, "1 c h w"]:
        images = torch.stack([encode(events, window.length_us) for events in window.channels])
        return images.view(1, -1, *images.shape[-2:])

    def of_stream(prediction: Prediction) -> Prediction:
        return each_map(prediction, lambda field: field[:, 0])

    def at_once(height: int, width: int) -> int:
        side = getattr(ready, "binning", 1)
        return windows_at_once(max(1, height // side), max(1, width // side))

    recoverer = network_recoverer(ready, place, precision, encoded, of_stream)._replace(at_once=at_once)
    trained_us = trained_window_us(metadata)
    return recoverer if trained_us is None else of_any_length(recoverer, trained_us)


def weighted_counts(steps: Sequence[float]) -> Encode:
    """Return an encoding like `event_counts`, in which an ON event counts steps[0] and an OFF event steps[1]."""

    def encode(events: Events, window_us: int) -> Float[Tensor, "2 h w"]:
        polarity, count = event_counts(events, window_us)
        on, off = steps[0] * (count + polarity) / 2, steps[1] * (count - polarity) / 2
        return torch.stack([on - off, on + off])

    return encode


def open_dolp_network(setup: Setup) -> Recoverer:
    """Open the DoLP network from the checkpoint in the setup."""
    network, metadata = load_network(weights_file(setup))
    options = (setup.config.thresholds, setup.config.binning) if isinstance(setup.config, DolpNetworkConfig) else ()
    return dolp_recoverer(network, metadata, setup.device, setup.precision, *options)


def open_e2p(setup: Setup) -> Recoverer:
    """Open E2P; its authors' weights saw one voxel grid of the whole mosaic, polarnet's checkpoints one a channel."""
    path = weights_file(setup)
    network, published = load_baseline({"e2p": E2p}, path).to(setup.device), path.suffix != ".safetensors"

    def encode(window: EventWindow) -> Float[Tensor, "1 bins h w"]:
        if published:
            return voxel_grid(join_mosaic(window.channels, MOSAIC), network.bins)[None]
        return interleaved(voxel_grids(window, network.bins))[None]

    def prediction_of(maps: Float[Tensor, "n 1 maps h w"]) -> Prediction:
        return Prediction(maps[:, 0, -1], angle_of(maps[:, 0]))

    return network_recoverer(network, setup.device, setup.precision, encode, prediction_of)


E2P = Method(
    name="e2p",
    label="E2P",
    colour="#7a5cc4",
    open=open_e2p,
    networks=("e2p",),
    about="E2P (Mei et al. 2023), a published network from events to polarization.",
)
METHODS = (
    E2P,
    replace(E2P, name="e2p_published", label="E2P, published weights", about=""),
    Method(
        name="paper",
        label="the paper's network",
        colour="#0ca678",
        open=open_dolp_network,
        networks=tuple(NETWORKS),
        about="The network of the paper (its Fig. 6), in polarnet's implementation: events of the four polarizers in, "
        "DoLP out.",
    ),
    Method(
        name="ours",
        label="ours",
        colour="#d6336c",
        open=open_dolp_network,
        config=DolpNetworkConfig,
        networks=tuple(NETWORKS),
        shipped=True,
        about="The DoLP network in use.",
    ),
)
