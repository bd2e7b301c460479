"""Output for readers: figures, tables and pages."""
