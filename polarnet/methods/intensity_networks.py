"""Networks that reconstruct intensity from events, as methods; the four channels form one batch.

E2VID (Rebecq et al., CVPR 2019 and TPAMI 2021), FireNet (Scheerlinck et al., WACV 2020), FireNet+ (Stoffregen et al.,
ECCV 2020), which takes voxel grids that are not normalised, and CISTA-TC (Liu and Dragotti, ICASSP 2022), whose images
its authors do not sharpen. Row `e2v` is the one that the pipeline trains.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.events.representations import normalise_nonzero, voxel_grid
from polarnet.events.streaming import EventWindow
from polarnet.methods import sharpening
from polarnet.methods.intensities import from_intensities, with_gain
from polarnet.methods.method import Method, Recoverer, Setup, State, Weights, weights_file
from polarnet.networks.base.checkpoint import load_checkpoint, load_tensors
from polarnet.networks.cista_tc.network import CistaTc
from polarnet.networks.e2v import ARCHITECTURES
from polarnet.networks.e2v.e2vid import E2vid
from polarnet.networks.e2v.firenet import FireNet
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
    about: str = "",
    normalised: bool = True,
    sharpened: bool = False,
) -> tuple[Method, Method]:
    """The method NAME that runs one of `networks`, and NAME+gain.

    See `intensity_network` for `normalised` and `sharpened`.
    """

    def open_network(setup: Setup) -> Recoverer:
        network = load_baseline(networks, weights_file(setup))
        return intensity_network(network, setup, normalised=normalised, sharpened=sharpened)

    method = Method(
        name=name,
        label=label,
        colour=colour,
        open=open_network,
        sharpened=sharpened,
        weights=Weights(tuple(networks)),
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
        return state, from_intensities(sharpening.sharpened(raw, setup.sharpening) if sharpened else raw.clamp(0, 1))

    return Recoverer(lambda height, width: None, predict, network=network)


def voxel_grids(window: EventWindow, bins: int) -> Float[Tensor, "c bins h w"]:
    """Voxel grid of each channel."""
    return torch.stack([voxel_grid(events, bins) for events in window.channels])


METHODS = (
    *intensity_methods("e2v", "E2V", "#3d8fd9", ARCHITECTURES, about="Events to video."),
    *intensity_methods("e2vid_published", "E2VID, published weights", "#2f6fb0", {"e2vid": E2vid}, sharpened=True),
    *intensity_methods(
        "firenet_published", "FireNet, published weights", "#3d8fd9", {"firenet": FireNet}, sharpened=True
    ),
    *intensity_methods(
        "firenetplus_published",
        "FireNet+, published weights",
        "#3d8fd9",
        {"firenet": FireNet},
        normalised=False,
        sharpened=True,
    ),
    *intensity_methods(
        "cista_tc",
        "CISTA-TC, published weights",
        "#4aa37c",
        {"cista_tc": CistaTc},
        about="CISTA-TC (Liu and Dragotti 2022), a recurrent network from events to intensity that unrolls sparse "
        "coding, one polarizer at a time, then DoLP by the Stokes formula.",
    ),
)
