"""E2V: the events-to-intensity network that the pipeline trains, selected by `baselines.e2v.arch`."""

from polarnet.methods.intensity_network import intensity_methods
from polarnet.networks.e2v import ARCHITECTURES

METHODS = intensity_methods("e2v", "E2V", "#3d8fd9", ARCHITECTURES, trained_by="e2v", about="Events to video.")
