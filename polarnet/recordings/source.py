"""What a format's module hands over: an opened file as blocks of columns, just as they stand in it."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from polarnet.events.stream import LARGEST_SIDE

BLOCK_EVENTS = 2**18  # what a format decodes at a time; what a reader's user gets is cut anew

WRAP_US = 2**32  # of time stamps of 32 bits

REPAIRS = {
    "unreadable_lines": "lines that are not the numbers they should be: left out",
    "unreadable_packages": "packages whose length or content cannot be right: left out",
    "cut_tail": "the file ends within a line, an event or a package: what is left of it is left out",
    "orphans": "events before the first row address or time of their package: left out",
    "no_change": "events of polarity 0, whose pixel did not change: left out",
    "bad_polarity": "events of a polarity that is neither brighter nor darker: left out",
    "out_of_range": "events that are not on the sensor: left out",
    "time_glitches": "events far from the time of those before and after them: left out",
    "unsorted": "events a little earlier than the one before: put in order",
    "pauses": "pauses of a second or more between events: kept",
}
"""What readers count. No event is ever given another time, pixel or polarity."""

SAFE = ("cut_tail", "no_change", "unsorted", "pauses")
"""Repairs that may concern any number of events; of the others a file with too many is refused."""


class RecordingError(ValueError):
    """A file that is not read, with the reason and what to do."""


class Block(NamedTuple):
    """Some events, as they stand in the file: columns of one length and any number type."""

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    p: np.ndarray


@dataclass(frozen=True)
class Choices:
    """What the user says about a file beyond its name; None where the file should say it."""

    height: int | None = None
    width: int | None = None
    part: str | None = None
    """SEQUENCE/ANGLE of an event store."""
    clock_mhz: float | int | None = None
    """Of a CeleX-5 that did not run at its usual clock."""
    assume_polarity: int | None = None
    """+1 or -1 for all events of a file that does not say which, None to refuse such a file."""


@dataclass(frozen=True)
class Source:
    """An opened file. `blocks(counts)` reads it from the start, and counts what it had to leave out."""

    height: int
    width: int
    blocks: Callable[[Counter[str]], Iterator[Block]]


def running_on(t: np.ndarray, turns: int, before: int) -> tuple[np.ndarray, int, int]:
    """Microseconds of 32 bits made to run on where they wrap; how often they have by then, and the last of them.

    `turns` and `before` are those of the block that came before, 0 at the start.
    """
    t = t.astype(np.int64)
    wrapped = np.cumsum(np.diff(t, prepend=before) < -WRAP_US // 2)
    return t + (turns + wrapped) * WRAP_US, turns + int(wrapped[-1]), int(t[-1])


def sensor_size(path: Path, choices: Choices, height: int | None = None, width: int | None = None) -> tuple[int, int]:
    """Height and width: those the file states, else those the user gave.

    RecordingError where nobody states them, where both do and differ, or where no sensor is of that size.
    """
    for name, stated, given in (("height", height, choices.height), ("width", width, choices.width)):
        if stated is not None and given is not None and stated != given:
            raise RecordingError(f"{path.name}: the file states a {name} of {stated} px, {given} was given; give none")
    height = choices.height if height is None else height
    width = choices.width if width is None else width
    if height is None or width is None:
        raise RecordingError(f"{path.name}: the file does not say how large the sensor is; give height and width")
    if not (0 < height <= LARGEST_SIDE and 0 < width <= LARGEST_SIDE):
        raise RecordingError(
            f"{path.name}: expected a sensor with sides of 1 to {LARGEST_SIDE} px, got {height}x{width}"
        )
    return height, width
