"""Configuration of all stages as one tree, the experiments, and the table of a sweep."""
