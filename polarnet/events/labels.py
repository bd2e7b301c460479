"""Labels of simulated events: the process in the pixel that caused each of them."""

LABELS = ("signal", "leak", "shot", "hot")
"""Name of each label, by its number: change of light, leak current, shot noise, hot pixel."""
SIGNAL = LABELS.index("signal")
