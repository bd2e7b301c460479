"""Networks that reconstruct intensity from events, as methods; the four channels form one batch."""

import functools
from collections.abc import Callable, Sequence
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
from polarnet.networks.checkpoint import load_checkpoint, load_tensors
from polarnet.stokes import Prediction


def load_baseline(build: Any, name: str, path: Path) -> Any:
    """Load the network `name` from a checkpoint of polarnet or a published file; ValueError for another network."""
    if path.suffix != ".safetensors":
        return build.load(path)
    tensors, metadata = load_checkpoint(path)
    if metadata["network"] != name:
        raise ValueError(f"{path} holds a {metadata['network']}, expected a {name}")
    network = build(**metadata["config"])
    load_tensors(network, tensors, path)
    return network.eval()


def intensity_methods(
    name: str,
    label: str,
    colour: str,
    build: Any,
    weights: Weights,
    *,
    about: str = "",
    normalised: bool = True,
    published: bool = False,
) -> tuple[Method, Method]:
    """The method NAME that runs a network of the class `build`, and NAME+gain.

    `weights` names that network alone; see `intensity_network` for `normalised` and `published`.
    """
    (network,) = weights.networks
    load = functools.partial(load_baseline, build, network)

    def open_network(setup: Setup) -> Recoverer:
        return intensity_network(load, setup, normalised=normalised, published=published)

    method = Method(
        name=name,
        label=label,
        colour=colour,
        open=open_network,
        config=WeightsConfig,
        weights=weights,
        reconstructs=True,
        about=about,
    )
    return method, with_gain(method)


def intensity_network(
    load: Callable[[Path], Any], setup: Setup, *, normalised: bool = True, published: bool = False
) -> Recoverer:
    """Load a network from the setup's weights and wrap it as a method that reconstructs intensities.

    `normalised` scales voxel grids to mean 0 and standard deviation 1, as in E2VID. `published` applies the
    post-processing of published weights; otherwise intensities are on their true scale and only clipped.
    """
    network = load(weights_file(setup)).to(setup.device)

    def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        images = []
        for window in windows:
            grids = voxel_grids(window, network.bins).to(setup.device)
            with setup.autocast():
                intensity, state = network(normalise_nonzero(grids) if normalised else grids, state)
            images.append(intensity.float())
        raw = torch.stack(images)
        return state, from_intensities(postprocessed(raw, setup.postprocessing) if published else raw.clamp(0, 1))

    return Recoverer(lambda height, width: None, predict, network=network)


def voxel_grids(window: EventWindow, bins: int) -> Float[Tensor, "4 bins h w"]:
    """Voxel grid of each channel."""
    return torch.stack([voxel_grid(events, bins) for events in window.channels])
