"""Files from real cameras, read as events."""
