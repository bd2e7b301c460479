"""E2P, which predicts intensity, AoLP and DoLP from a polarizer mosaic."""
