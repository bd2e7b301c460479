"""Studies of a method beyond its scores: event budget, sensitivity to sensor and motion, real recordings."""
