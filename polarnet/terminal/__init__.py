"""Output on a terminal and messages: progress, interrupts, advice on missing extras; no stage depends on it."""
