"""Networks of the E2V baseline by name: `baselines.e2v.arch` selects one, and its checkpoint names it."""

from polarnet.networks.e2v.e2vid import E2vid
from polarnet.networks.e2v.firenet import FireNet

ARCHITECTURES: dict[str, type[FireNet] | type[E2vid]] = {"firenet": FireNet, "e2vid": E2vid}
