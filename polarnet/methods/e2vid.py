"""E2VID (Rebecq et al., CVPR 2019 and TPAMI 2021), trained by the pipeline or with its authors' weights."""

import functools

from polarnet.methods.intensities import with_gain
from polarnet.methods.intensity_network import intensity_network, load_baseline
from polarnet.methods.method import Method, Recoverer, Setup, Weights, WeightsConfig
from polarnet.networks.e2vid import E2vid

load = functools.partial(load_baseline, E2vid, "e2vid")


def open_e2vid(setup: Setup) -> Recoverer:
    """Open E2VID with weights trained by the pipeline."""
    return intensity_network(load, setup)


def open_e2vid_published(setup: Setup) -> Recoverer:
    """Open E2VID with its authors' weights."""
    return intensity_network(load, setup, published=True)


E2VID = Method(
    name="e2vid",
    label="E2VID",
    colour="#2f6fb0",
    open=open_e2vid,
    config=WeightsConfig,
    weights=Weights(("e2vid",), trained_by="e2v", remedy="train one with baselines.e2v.arch=e2vid"),
    reconstructs=True,
    about="E2VID (Rebecq et al. 2019), a recurrent network from events to intensity, one polarizer at a time, then "
    "DoLP by the Stokes formula.",
)
PUBLISHED = Method(
    name="e2vid_published",
    label="E2VID, published weights",
    colour=E2VID.colour,
    open=open_e2vid_published,
    config=WeightsConfig,
    weights=Weights(("e2vid",)),
    reconstructs=True,
)
METHODS = (E2VID, with_gain(E2VID), PUBLISHED, with_gain(PUBLISHED))
