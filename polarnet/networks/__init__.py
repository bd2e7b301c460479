"""Layers and networks that recover polarization from events."""
