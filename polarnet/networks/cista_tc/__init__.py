"""CISTA-TC, which reconstructs intensities by sparse coding along the motion."""
