"""E2P, a published network from events to polarization (Mei et al., CVPR 2023), trained by the pipeline."""

from collections.abc import Sequence

import torch

from polarnet.events.streaming import EventWindow
from polarnet.methods.intensity_network import load_baseline, voxel_grids
from polarnet.methods.method import Method, Recoverer, Setup, State, Weights, WeightsConfig, weights_file
from polarnet.networks.e2p import BRANCHES, E2p, decoded_aolp, interleaved
from polarnet.stokes import Prediction


def open_e2p(setup: Setup) -> Recoverer:
    """Open E2P, which takes the four channels interleaved as a mosaic of twice the height and width."""
    network = load_baseline({"e2p": E2p}, weights_file(setup)).to(setup.device)

    def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        frames = []
        for window in windows:
            mosaic = interleaved(voxel_grids(window, network.bins).to(setup.device))[None]
            with setup.autocast():
                maps, state = network(mosaic, state)
            frames.append(maps[0].float())
        branches = dict(zip(BRANCHES, torch.stack(frames, dim=1), strict=True))
        return state, Prediction(branches["dolp"], decoded_aolp(branches["aolp"]))

    return Recoverer(lambda height, width: None, predict, network=network)


METHODS = (
    Method(
        name="e2p",
        label="E2P",
        colour="#7a5cc4",
        open=open_e2p,
        config=WeightsConfig,
        weights=Weights(("e2p",), trained_by="e2p"),
        about="E2P (Mei et al. 2023), a published network from events to polarization.",
    ),
)
