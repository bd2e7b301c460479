"""What the CSV and the BIN files of a CeleX-5 share: the sensor, its clock, and the reason to refuse some modes."""

from pathlib import Path

import numpy as np

from polarnet.recordings.source import Choices, RecordingError

HEIGHT, WIDTH = 800, 1280
WHITE = 4095  # of its 12 bit converter

CLOCK_MHZ = 100.0  # the vendor's default
TICK_CYCLES = 1024  # of the clock; one step of the time stamps


def microseconds(ticks: np.ndarray, clock_mhz: float | int) -> np.ndarray:
    """Time stamps of the sensor as microseconds, rounded down, as the vendor's library does."""
    clock_khz = round(1000 * clock_mhz)
    return np.asarray(ticks, np.int64) * (1000 * TICK_CYCLES) // clock_khz


def ticks(t_us: np.ndarray, clock_mhz: float | int) -> np.ndarray:
    """The first time stamps at or after these times."""
    clock_khz = round(1000 * clock_mhz)
    return -(-np.asarray(t_us, np.int64) * clock_khz // (1000 * TICK_CYCLES))


def polarity_to_assume(path: Path, mode: str, choices: Choices) -> int:
    """The polarity that the user gave for all events of a mode that has none; RecordingError without it."""
    if choices.assume_polarity is None:
        raise RecordingError(
            f"{path.name}: events of a CeleX-5 in its mode {mode} have no polarity, so nothing can be recovered from "
            f"them; record in Event Intensity mode. assume_polarity=1 reads them to look at"
        )
    return choices.assume_polarity
