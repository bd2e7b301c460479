"""One thin Hydra entry point per DVC stage."""
