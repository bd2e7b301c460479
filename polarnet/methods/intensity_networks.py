"""Networks that reconstruct intensity from events, as methods; the four channels form one batch.

E2VID (Rebecq et al., CVPR 2019 and TPAMI 2021), FireNet (Scheerlinck et al., WACV 2020), FireNet+ (Stoffregen et al.,
ECCV 2020), which takes voxel grids that are not normalised, and CISTA-TC (Liu and Dragotti, ICASSP 2022), whose images
its authors do not sharpen. Row `e2v` is the one that the pipeline trains.
"""

from collections.abc import Mapping
from pathlib import Path
from statistics import NormalDist
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from polarnet.events.representations import normalise_nonzero, voxel_grid
from polarnet.events.streaming import EventWindow
from polarnet.methods.intensities import from_intensities, with_gain
from polarnet.methods.method import Method, Recoverer, Setup, network_recoverer, weights_file
from polarnet.networks.base.checkpoint import load_checkpoint, load_tensors
from polarnet.networks.cista_tc.network import CistaTc
from polarnet.networks.e2v.network import ARCHITECTURES, E2vid, FireNet
from polarnet.stokes import Prediction

UNSHARP_AMOUNT, UNSHARP_SIGMA = 0.3, 1.0  # defaults of E2VID's authors; sigma in the units of their kernel
KERNEL_SIZE = 5  # pixels

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

    `normalised` scales voxel grids to mean 0 and standard deviation 1, as in E2VID. `sharpened` applies the
    post-processing of E2VID's authors; otherwise intensities are on their true scale and only clipped.
    """

    def open_network(setup: Setup) -> Recoverer:
        network = load_baseline(networks, weights_file(setup)).to(setup.device)

        def encode(window: EventWindow) -> Float[Tensor, "c bins h w"]:
            grids = voxel_grids(window, network.bins).to(setup.device)
            return normalise_nonzero(grids) if normalised else grids

        def prediction_of(raw: Float[Tensor, "n c h w"]) -> Prediction:
            return from_intensities(sharper(raw) if sharpened else raw.clamp(0, 1))

        return network_recoverer(network, setup.device, setup.precision, encode, prediction_of)

    method = Method(
        name=name,
        label=label,
        colour=colour,
        open=open_network,
        networks=tuple(networks),
        reconstructs=True,
        about=about,
    )
    return method, with_gain(method)


def voxel_grids(window: EventWindow, bins: int) -> Float[Tensor, "c bins h w"]:
    """Voxel grid of each channel."""
    return torch.stack([voxel_grid(events, bins) for events in window.channels])


def sharper(images: Float[Tensor, "t c h w"]) -> Float[Tensor, "t c h w"]:
    """Post-processing by E2VID's authors: (1 + amount) image - amount blurred, mirrored at the border, then clipped.

    The authors then round images to 8 bits; polarnet does not.
    """
    kernel = blur_kernel().to(images)[None, None]
    padded = F.pad(images.flatten(0, 1)[:, None], (KERNEL_SIZE // 2,) * 4, mode="reflect")
    blurred = F.conv2d(padded, kernel).view_as(images)
    return ((1 + UNSHARP_AMOUNT) * images - UNSHARP_AMOUNT * blurred).clamp(0, 1)


def blur_kernel() -> Float[Tensor, "5 5"]:
    """The published kernel: square root of the outer product of 5 normal bin probabilities, with sum 1.

    The bins lie in [-sigma - step / 2, sigma + step / 2] of the standard normal, step = (2 sigma + 1) / 5.
    """
    step = (2 * UNSHARP_SIGMA + 1) / KERNEL_SIZE
    last = UNSHARP_SIGMA + step / 2
    edges = torch.linspace(-last, last, KERNEL_SIZE + 1, dtype=torch.float64)
    shares = torch.tensor([NormalDist().cdf(edge) for edge in edges.tolist()], dtype=torch.float64).diff()
    kernel = torch.outer(shares, shares).sqrt()
    return kernel / kernel.sum()


FIRENET = {"firenet": FireNet}
METHODS = (
    *intensity_methods("e2v", "E2V", "#3d8fd9", ARCHITECTURES, about="Events to video."),
    *intensity_methods("e2vid_published", "E2VID, published weights", "#2f6fb0", {"e2vid": E2vid}, sharpened=True),
    *intensity_methods("firenet_published", "FireNet, published weights", "#3d8fd9", FIRENET, sharpened=True),
    *intensity_methods(
        "firenetplus_published", "FireNet+, published weights", "#3d8fd9", FIRENET, normalised=False, sharpened=True
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
