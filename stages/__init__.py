"""Hydra entry points, one for each DVC stage."""
