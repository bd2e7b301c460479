"""DoLP networks by their names in params.yaml. A new network needs one module and one entry here."""

from typing import Any

from polarnet.networks.dolp_unet import DolpUNet, DolpUNetConfig
from polarnet.networks.stokes_unet import StokesUNet, StokesUNetConfig

NetworkConfig = DolpUNetConfig | StokesUNetConfig

NETWORKS: dict[str, tuple[type[Any], type[NetworkConfig]]] = {
    "paper": (DolpUNet, DolpUNetConfig),
    "polarnet": (StokesUNet, StokesUNetConfig),
}
"""Class of each network, and class of its section in params.yaml."""
