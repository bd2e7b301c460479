"""Conditions of a comparison, and recordings with truth as a test set."""
