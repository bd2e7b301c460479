"""Estimators of a real sensor's parameters from its recordings, and the comparison with its simulated twin."""
