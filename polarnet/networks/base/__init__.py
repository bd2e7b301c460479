"""What networks share: layers, checkpoints, and the loading of published weights."""
