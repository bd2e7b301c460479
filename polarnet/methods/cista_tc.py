"""CISTA-TC with its authors' weights (Liu, Dragotti, ICASSP 2022)."""

import functools

from polarnet.methods.intensities import with_gain
from polarnet.methods.intensity_network import intensity_network, load_baseline
from polarnet.methods.method import Method, Recoverer, Setup, Weights, WeightsConfig
from polarnet.networks.cista_tc import CistaTc

load = functools.partial(load_baseline, CistaTc, "cista_tc")


def open_cista_tc(setup: Setup) -> Recoverer:
    """CISTA-TC, without E2VID's post-processing of the images."""
    return intensity_network(load, setup)


CISTA_TC = Method(
    name="cista_tc",
    label="CISTA-TC, published weights",
    colour="#4aa37c",
    open=open_cista_tc,
    config=WeightsConfig,
    weights=Weights(("cista_tc",)),
    reconstructs=True,
    about="CISTA-TC (Liu and Dragotti 2022), a recurrent network from events to intensity that unrolls sparse coding, "
    "one polarizer at a time, then DoLP by the Stokes formula.",
)
METHODS = (CISTA_TC, with_gain(CISTA_TC))
