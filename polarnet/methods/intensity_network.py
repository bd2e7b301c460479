"""Networks that reconstruct intensity from events, as methods; the four channels form one batch."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.events.representations import normalise_nonzero, voxel_grid
from polarnet.events.streaming import EventWindow
from polarnet.methods.intensities import from_intensities, with_gain
from polarnet.methods.method import Method, Recoverer, Setup, State, Weights, WeightsConfig, weights_file
from polarnet.methods.postprocessing import postprocessed
from polarnet.networks.base.checkpoint import load_checkpoint, load_tensors
from polarnet.stokes import Prediction

Networks = Mapping[str, Any]
"""Class of each network that a method accepts, by the name in its checkpoints."""


def load_baseline(networks: Networks, path: Path) -> Any:
    """Load a checkpoint of polarnet, or the published file of a single network; ValueError for another network."""
    if path.suffix != ".safetensors" and len(networks) == 1:
        (build,) = networks.values()
        return build.load(path)
    tensors, metadata = load_checkpoint(path)
    if metadata["network"] not in networks:
        raise ValueError(f"{path} holds a {metadata['network']}, expected a {' or '.join(networks)}")
    network = networks[metadata["network"]](**metadata["config"])
    load_tensors(network, tensors, path)
    return network.eval()


def intensity_methods(
    name: str,
    label: str,
    colour: str,
    networks: Networks,
    *,
    trained_by: str | None = None,
    remedy: str = "",
    about: str = "",
    normalised: bool = True,
    sharpened: bool = False,
) -> tuple[Method, Method]:
    """The method NAME that runs one of `networks`, and NAME+gain.

    `trained_by` and `remedy` are those of `Weights`; see `intensity_network` for `normalised` and `sharpened`.
    """

    def open_network(setup: Setup) -> Recoverer:
        network = load_baseline(networks, weights_file(setup))
        return intensity_network(network, setup, normalised=normalised, sharpened=sharpened)

    method = Method(
        name=name,
        label=label,
        colour=colour,
        open=open_network,
        config=WeightsConfig,
        weights=Weights(tuple(networks), trained_by, remedy),
        reconstructs=True,
        about=about,
    )
    return method, with_gain(method)


def intensity_network(network: Any, setup: Setup, *, normalised: bool = True, sharpened: bool = False) -> Recoverer:
    """Wrap a network as a method that reconstructs intensities.

    `normalised` scales voxel grids to mean 0 and standard deviation 1, as in E2VID. `sharpened` applies the
    post-processing of E2VID's authors; otherwise intensities are on their true scale and only clipped.
    """
    network = network.to(setup.device)

    def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        images = []
        for window in windows:
            grids = voxel_grids(window, network.bins).to(setup.device)
            with setup.autocast():
                intensity, state = network(normalise_nonzero(grids) if normalised else grids, state)
            images.append(intensity.float())
        raw = torch.stack(images)
        return state, from_intensities(postprocessed(raw, setup.postprocessing) if sharpened else raw.clamp(0, 1))

    return Recoverer(lambda height, width: None, predict, network=network)


def voxel_grids(window: EventWindow, bins: int) -> Float[Tensor, "c bins h w"]:
    """Voxel grid of each channel."""
    return torch.stack([voxel_grid(events, bins) for events in window.channels])
