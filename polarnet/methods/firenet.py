"""FireNet (Scheerlinck et al., WACV 2020) and FireNet+, trained by the pipeline or with their authors' weights."""

import functools

from polarnet.methods.intensities import with_gain
from polarnet.methods.intensity_network import intensity_network, load_baseline
from polarnet.methods.method import Method, Recoverer, Setup, Weights, WeightsConfig
from polarnet.networks.firenet import FireNet

load = functools.partial(load_baseline, FireNet, "firenet")


def open_firenet(setup: Setup) -> Recoverer:
    """Open FireNet with weights trained by the pipeline."""
    return intensity_network(load, setup)


def open_firenet_published(setup: Setup) -> Recoverer:
    """Open FireNet with its authors' weights."""
    return intensity_network(load, setup, published=True)


def open_firenetplus_published(setup: Setup) -> Recoverer:
    """Open FireNet+ with its authors' weights, without normalised voxel grids (Stoffregen et al., ECCV 2020)."""
    return intensity_network(load, setup, normalised=False, published=True)


FIRENET = Method(
    name="firenet",
    label="FireNet",
    colour="#3d8fd9",
    open=open_firenet,
    config=WeightsConfig,
    weights=Weights(("firenet",), trained_by="e2v", remedy="train one with baselines.e2v.arch=firenet"),
    reconstructs=True,
    about="FireNet (Scheerlinck et al. 2020), a recurrent network from events to intensity, one polarizer at a time, "
    "then DoLP by the Stokes formula.",
)
PUBLISHED = Method(
    name="firenet_published",
    label="FireNet, published weights",
    colour=FIRENET.colour,
    open=open_firenet_published,
    config=WeightsConfig,
    weights=Weights(("firenet",)),
    reconstructs=True,
)
PLUS = Method(
    name="firenetplus_published",
    label="FireNet+, published weights",
    colour=FIRENET.colour,
    open=open_firenetplus_published,
    config=WeightsConfig,
    weights=Weights(("firenet",)),
    reconstructs=True,
)
METHODS = (FIRENET, with_gain(FIRENET), PUBLISHED, with_gain(PUBLISHED), PLUS, with_gain(PLUS))
