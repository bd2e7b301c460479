"""E2P, a published network from events to polarization (Mei et al., CVPR 2023), trained here or by its authors."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.events.mosaic import join_mosaic
from polarnet.events.representations import voxel_grid
from polarnet.events.streaming import EventWindow
from polarnet.methods.intensity_networks import load_baseline, voxel_grids
from polarnet.methods.method import Method, Recoverer, Setup, State, Weights, weights_file
from polarnet.networks.e2p.network import MOSAIC, E2p, angle_of, interleaved
from polarnet.stokes import Prediction


def open_e2p(setup: Setup) -> Recoverer:
    """Open E2P, which takes the four channels interleaved as a mosaic of twice the height and width."""
    return _recoverer(setup, published=False)


def open_published(setup: Setup) -> Recoverer:
    """Open E2P with its authors' weights, which saw one voxel grid of the whole mosaic."""
    return _recoverer(setup, published=True)


def _recoverer(setup: Setup, *, published: bool) -> Recoverer:
    network = load_baseline({"e2p": E2p}, weights_file(setup)).to(setup.device)

    def grid(window: EventWindow) -> Float[Tensor, "bins h w"]:
        if published:
            return voxel_grid(join_mosaic(window.channels, MOSAIC), network.bins)
        return interleaved(voxel_grids(window, network.bins))

    def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        frames = []
        for window in windows:
            with setup.autocast():
                maps, state = network(grid(window).to(setup.device)[None], state)
            frames.append(maps[0].float())
        maps = torch.stack(frames)
        return state, Prediction(maps[:, -1], angle_of(maps))

    return Recoverer(lambda height, width: None, predict, network=network)


METHODS = (
    Method(
        name="e2p",
        label="E2P",
        colour="#7a5cc4",
        open=open_e2p,
        weights=Weights(("e2p",)),
        about="E2P (Mei et al. 2023), a published network from events to polarization.",
    ),
    Method(
        name="e2p_published",
        label="E2P, published weights",
        colour="#7a5cc4",
        open=open_published,
        weights=Weights(("e2p",)),
    ),
)
