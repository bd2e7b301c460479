"""Consecutive time steps of one channel: the record that every pixel model takes beside light and pixel state."""

from typing import Any, NamedTuple

import numpy as np


class Steps(NamedTuple):
    """A span of time of one channel. Step k lasts from times_us[k] to times_us[k + 1] and ends with one frame."""

    physics: Any
    """Parameters of the pixel model, as its `physics_of` returns them."""
    height: int
    width: int
    times_us: np.ndarray
    """float64 [steps + 1], strictly increasing."""
    first_frame: int
    """Index into the light of the frame at times_us[1]."""
    first_number: int
    """Number of steps that the channel has taken before; random draws are numbered by it."""
    key: np.uint64
    """Seed of all noise of the sensor."""
    channel: int
    """Number of the channel; each channel has its own mismatch and noise."""
