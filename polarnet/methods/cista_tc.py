"""CISTA-TC with its authors' weights (Liu, Dragotti, ICASSP 2022), without E2VID's post-processing of the images."""

from polarnet.methods.intensity_network import intensity_methods
from polarnet.networks.cista_tc.network import CistaTc

METHODS = intensity_methods(
    "cista_tc",
    "CISTA-TC, published weights",
    "#4aa37c",
    {"cista_tc": CistaTc},
    about="CISTA-TC (Liu and Dragotti 2022), a recurrent network from events to intensity that unrolls sparse coding, "
    "one polarizer at a time, then DoLP by the Stokes formula.",
)
