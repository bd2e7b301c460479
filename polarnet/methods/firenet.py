"""FireNet (Scheerlinck et al., WACV 2020) and FireNet+, trained by the pipeline or with their authors' weights.

FireNet+ (Stoffregen et al., ECCV 2020) takes voxel grids that are not normalised.
"""

from polarnet.methods.intensity_network import intensity_methods
from polarnet.networks.e2v.firenet import FireNet

COLOUR = "#3d8fd9"
NETWORKS = {"firenet": FireNet}
METHODS = (
    *intensity_methods(
        "firenet",
        "FireNet",
        COLOUR,
        NETWORKS,
        trained_by="e2v",
        remedy="train one with baselines.e2v.arch=firenet",
        about="FireNet (Scheerlinck et al. 2020), a recurrent network from events to intensity, one polarizer at a "
        "time, then DoLP by the Stokes formula.",
    ),
    *intensity_methods("firenet_published", "FireNet, published weights", COLOUR, NETWORKS, sharpened=True),
    *intensity_methods(
        "firenetplus_published", "FireNet+, published weights", COLOUR, NETWORKS, normalised=False, sharpened=True
    ),
)
