"""Recurrent networks that predict DoLP from the events of a window, as methods."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import Field, PositiveFloat
from torch import Tensor, nn

from polarnet.events.representations import REPRESENTATIONS, Encode, event_counts
from polarnet.events.stream import Events
from polarnet.events.streaming import EventWindow
from polarnet.methods.method import Recoverer, Setup, State, WeightsConfig, each_map, weights_file
from polarnet.networks.checkpoint import load_network
from polarnet.networks.registry import NETWORKS
from polarnet.runtime.sections import section
from polarnet.stokes import Prediction

DOLP_NETWORKS = tuple(NETWORKS)
COUNTS = "event_counts"  # the representation whose images scale with the threshold


@section
class DolpNetworkConfig(WeightsConfig):
    """Section `methods.ours` of params.yaml."""

    thresholds: Annotated[list[PositiveFloat], Field(min_length=2, max_length=2)] | None
    """Contrast thresholds of the camera, ON and OFF; null: those of the training."""


def encoded(windows: Sequence[EventWindow], encode: Encode) -> Float[Tensor, "n c h w"]:
    """Encode every window, with the channels concatenated along the second axis."""
    return torch.stack([_encoded(window, encode) for window in windows])


def dolp_recoverer(
    network: nn.Module,
    metadata: Mapping[str, Any],
    device: torch.device | str = "cpu",
    precision: str = "fp32",
    thresholds: Sequence[float] | None = None,
) -> Recoverer:
    """Wrap a network and the metadata of its checkpoint (`load_network`) as a method.

    `precision` is fp32 or bf16 (autocast). Windows should be as long as in training. For DoLP at a higher rate, let
    windows of that length overlap (`polarnet.methods.overlap`). `thresholds` are the camera's contrast thresholds, ON
    and OFF: its events then count in the steps that the network was trained with (`in_steps_of_training`).
    """
    place = torch.device(device)
    ready: Any = network.to(place, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
    encode = REPRESENTATIONS[metadata["representation"]]
    if thresholds is not None:
        encode = in_steps_of_training(metadata, thresholds)

    def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        inputs = encoded(windows, encode)[:, None].to(place)
        with torch.autocast(place.type, torch.bfloat16, enabled=precision == "bf16"):
            prediction, state = ready.unroll(inputs, state)
        return state, each_map(prediction, lambda field: field[:, 0])

    return Recoverer(lambda height, width: None, predict, network=ready)


def open_dolp_network(setup: Setup) -> Recoverer:
    """Open the DoLP network from the checkpoint in the setup."""
    network, metadata = load_network(weights_file(setup))
    thresholds = setup.config.thresholds if isinstance(setup.config, DolpNetworkConfig) else None
    return dolp_recoverer(network, metadata, setup.device, setup.precision, thresholds)


def in_steps_of_training(metadata: Mapping[str, Any], thresholds: Sequence[float]) -> Encode:
    """`event_counts` for a camera with other contrast thresholds (ON, OFF) than those of the training.

    An event of threshold c changes the logarithm of the light by c, so it counts as c over the training's threshold. If
    both thresholds are above the training's, the smaller one counts 1: the redundancy needs no common factor, and
    larger counts with gaps between them are unlike any in training (worse on validation photographs).
    ValueError if a threshold is not above 0, if the network takes another representation, or if its checkpoint does not
    name its thresholds.
    """
    if min(thresholds) <= 0:
        raise ValueError(f"thresholds: expected numbers above 0 (ON, OFF), got {list(thresholds)}")
    if metadata["representation"] != COUNTS:
        raise ValueError(
            f"thresholds: expected a network that takes {COUNTS}, this one takes {metadata['representation']}; "
            f"leave the thresholds out"
        )
    sensor = metadata.get("data", {}).get("events_from", {}).get("emulate")
    if sensor is None:
        raise ValueError("thresholds: the checkpoint does not name the sensor of its training; leave them out")
    steps = [
        threshold / sensor[f"contrast_threshold_{polarity}"]
        for threshold, polarity in zip(thresholds, ("on", "off"), strict=True)
    ]
    steps = [step / max(1.0, min(steps)) for step in steps]

    def encode(events: Events, window_us: int) -> Float[Tensor, "2 h w"]:
        polarity, count = event_counts(events, window_us)
        on, off = steps[0] * (count + polarity) / 2, steps[1] * (count - polarity) / 2
        return torch.stack([on - off, on + off])

    return encode


def _encoded(window: EventWindow, encode: Encode) -> Float[Tensor, "c h w"]:
    images = [encode(events, window.length_us) for events in window.channels]
    return torch.cat([image.view(-1, *image.shape[-2:]) for image in images])
