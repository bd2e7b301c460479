"""Studies of speed and quality, and the writers of the tables in README and docs; not part of the installed package."""
