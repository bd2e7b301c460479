"""E2V: the events-to-intensity network that the pipeline trains, selected by `baselines.e2v.arch`."""

from pathlib import Path
from typing import Any

from polarnet.methods.intensities import with_gain
from polarnet.methods.intensity_network import intensity_network, load_baseline
from polarnet.methods.method import Method, Recoverer, Setup, Weights, WeightsConfig
from polarnet.networks.checkpoint import load_checkpoint
from polarnet.networks.e2v import ARCHITECTURES


def load(path: Path) -> Any:
    """Load the network named in the checkpoint; ValueError if it is not in `ARCHITECTURES`."""
    name = load_checkpoint(path)[1]["network"]
    if name not in ARCHITECTURES:
        raise ValueError(f"{path} holds a {name}, expected a {' or '.join(ARCHITECTURES)}")
    return load_baseline(ARCHITECTURES[name], name, path)


def open_e2v(setup: Setup) -> Recoverer:
    """Open the network of the checkpoint, with intensities on their true scale."""
    return intensity_network(load, setup)


E2V = Method(
    name="e2v",
    label="E2V",
    colour="#3d8fd9",
    open=open_e2v,
    config=WeightsConfig,
    weights=Weights(tuple(ARCHITECTURES), trained_by="e2v"),
    reconstructs=True,
    about="Events to video.",
)
METHODS = (E2V, with_gain(E2V))
