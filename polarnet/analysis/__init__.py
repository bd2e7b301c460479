"""Beyond the scores of a method: conditions of a comparison, recordings with truth."""
