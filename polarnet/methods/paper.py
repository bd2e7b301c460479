"""The paper's network, or another DoLP network to compare with polarnet's."""

from polarnet.methods.dolp_network import DOLP_NETWORKS, open_dolp_network
from polarnet.methods.method import Method, Weights

METHODS = (
    Method(
        name="paper",
        label="the paper's network",
        colour="#0ca678",
        open=open_dolp_network,
        weights=Weights(DOLP_NETWORKS),
        about="The network of the paper (its Fig. 6), in polarnet's implementation: events of the four polarizers in, "
        "DoLP out.",
    ),
)
