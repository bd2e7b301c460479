"""The DoLP network that the pipeline trains: polarnet's own unless `network` selects another."""

from polarnet.methods.dolp_network import DOLP_NETWORKS, DolpNetworkConfig, open_dolp_network
from polarnet.methods.method import Method, Weights

METHODS = (
    Method(
        name="ours",
        label="ours",
        colour="#d6336c",
        open=open_dolp_network,
        config=DolpNetworkConfig,
        weights=Weights(DOLP_NETWORKS, shipped=True),
        about="The DoLP network in use.",
    ),
)
