"""Common parts of the CeleX-5 CSV and BIN readers: sensor size, clock, and the refusal of modes without polarity."""

from pathlib import Path

import numpy as np

from polarnet.recordings.source import Choices, RecordingError

HEIGHT, WIDTH = 800, 1280
WHITE = 4095  # maximum of the 12-bit converter

CLOCK_MHZ = 100.0  # the vendor's default
TICK_CYCLES = 1024  # clock cycles per step of the time stamp


def microseconds(ticks: np.ndarray, clock_mhz: float | int) -> np.ndarray:
    """Convert the sensor's time stamps to microseconds, rounded down as in the vendor's library."""
    clock_khz = round(1000 * clock_mhz)
    return np.asarray(ticks, np.int64) * (1000 * TICK_CYCLES) // clock_khz


def ticks(t_us: np.ndarray, clock_mhz: float | int) -> np.ndarray:
    """The first time stamp at or after each time."""
    clock_khz = round(1000 * clock_mhz)
    return -(-np.asarray(t_us, np.int64) * clock_khz // (1000 * TICK_CYCLES))


def polarity_to_assume(path: Path, mode: str, choices: Choices) -> int:
    """The polarity given by the user for all events of a mode without polarity; RecordingError if none is given."""
    if choices.assume_polarity is None:
        raise RecordingError(
            f"{path.name}: events of a CeleX-5 in its mode {mode} have no polarity, so nothing can be recovered from "
            f"them; record in Event Intensity mode. assume_polarity=1 reads them to look at"
        )
    return choices.assume_polarity
