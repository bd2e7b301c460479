"""E2VID (Rebecq et al., CVPR 2019 and TPAMI 2021), trained by the pipeline or with its authors' weights."""

from polarnet.methods.intensity_network import intensity_methods
from polarnet.networks.e2v.e2vid import E2vid

COLOUR = "#2f6fb0"
NETWORKS = {"e2vid": E2vid}
METHODS = (
    *intensity_methods(
        "e2vid",
        "E2VID",
        COLOUR,
        NETWORKS,
        trained_by="e2v",
        remedy="train one with baselines.e2v.arch=e2vid",
        about="E2VID (Rebecq et al. 2019), a recurrent network from events to intensity, one polarizer at a time, then "
        "DoLP by the Stokes formula.",
    ),
    *intensity_methods("e2vid_published", "E2VID, published weights", COLOUR, NETWORKS, sharpened=True),
)
