"""Events of polarizer channels and their ground truth: the contract between producers and consumers."""
