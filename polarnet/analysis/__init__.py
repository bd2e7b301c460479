"""Beyond the scores of a method: event budget, conditions of a comparison, recordings with truth."""
