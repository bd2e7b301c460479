"""Degree of linear polarization from event cameras: simulated training data, a recovery network, its benchmark."""

import os

# Before anything loads torch: its OpenMP threads would spin while they wait for one another, and take the cores from
# whatever they wait for on a machine that does something else as well (a second job, a CI runner). So they sleep, but
# not at once, because a network is many short operations (GOMP_SPINCOUNT=0 studies/training.py compares).
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "10000")  # turns of a loop

__version__ = "0.1.0"
