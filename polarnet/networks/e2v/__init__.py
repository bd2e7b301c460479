"""Networks of the E2V baseline: E2VID and FireNet."""
