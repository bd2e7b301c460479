"""From pictures to polarization events: scenes, motion, and the pixels of an event camera."""
