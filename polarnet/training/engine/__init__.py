"""What all trainings share: loop, losses, sequences, optimizers, recording, calibration."""
