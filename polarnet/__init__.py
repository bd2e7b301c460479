"""Degree of linear polarization from event cameras: simulated training data, a recovery network, its benchmark."""

__version__ = "1.0.0"
