"""Training tasks, losses, optimizers and the training loop."""
