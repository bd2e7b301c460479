"""Layers and networks that recover polarization from events."""

from typing import TYPE_CHECKING

from polarnet.terminal.lazy import attach

if TYPE_CHECKING:
    from polarnet.networks.registry import load_network as load_network
    from polarnet.networks.weights import shipped_weights as shipped_weights

__getattr__, __dir__, __all__ = attach(__name__, __file__)
