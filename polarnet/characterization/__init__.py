"""Estimators of a real sensor's parameters from its recordings."""
