"""E2V: the events-to-intensity network that the pipeline trains, selected by `baselines.e2v.arch`."""

from pathlib import Path
from typing import Any

from polarnet.methods.intensities import with_gain
from polarnet.methods.intensity_network import intensity_network, load_baseline
from polarnet.methods.method import Method, Recoverer, Setup, Weights, WeightsConfig
from polarnet.networks.checkpoint import load_checkpoint
from polarnet.networks.e2vid import E2vid
from polarnet.networks.firenet import FireNet

NETWORKS = {"firenet": FireNet, "e2vid": E2vid}


def load(path: Path) -> Any:
    """Load the network named in the checkpoint; ValueError if it is not in `NETWORKS`."""
    name = load_checkpoint(path)[1]["network"]
    if name not in NETWORKS:
        raise ValueError(f"{path} holds a {name}, expected a {' or '.join(NETWORKS)}")
    return load_baseline(NETWORKS[name], name, path)


def open_e2v(setup: Setup) -> Recoverer:
    """Open the network of the checkpoint, with intensities on their true scale."""
    return intensity_network(load, setup)


E2V = Method(
    name="e2v",
    label="E2V",
    colour="#3d8fd9",
    open=open_e2v,
    config=WeightsConfig,
    weights=Weights(tuple(NETWORKS), trained_by="train_e2v"),
    reconstructs=True,
    about="Events to video.",
)
METHODS = (E2V, with_gain(E2V))
