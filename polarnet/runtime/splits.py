"""The splits of pictures, scenes and sequences."""

SPLITS = ("train", "val", "test")
