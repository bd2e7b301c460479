"""The networks that recover polarization, by their names in params.yaml. Another one is one module and one entry."""

from typing import Any

from polarnet.networks.dolp_unet import DolpUNet, DolpUNetConfig
from polarnet.networks.stokes_unet import StokesUNet, StokesUNetConfig

NetworkConfig = DolpUNetConfig | StokesUNetConfig

NETWORKS: dict[str, tuple[type[Any], type[NetworkConfig]]] = {
    "paper": (DolpUNet, DolpUNetConfig),
    "polarnet": (StokesUNet, StokesUNetConfig),
}
"""Each network, and the class of its section in params.yaml."""
