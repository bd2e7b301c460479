"""The interface of a file format's module: an opened file that yields its columns in blocks, unchanged."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from polarnet.events.stream import MAX_SIDE

BLOCK_EVENTS = 2**18  # events that a format decodes at a time; chunks handed to a user are cut anew

MAX_LISTED = 16  # parts of a recording in a message
MAX_PIXELS = 2**24  # of a sensor; the largest event cameras have 1.3 million

REPAIRS = {
    "unreadable_lines": "lines that are not the numbers they should be: left out",
    "unreadable_packages": "packages whose length or content cannot be right: left out",
    "cut_tail": "the file ends within a line, an event or a package: what is left of it is left out",
    "orphans": "events before the first row address or time of their package: left out",
    "no_change": "events of polarity 0, whose pixel did not change: left out",
    "bad_polarity": "events of a polarity that is neither brighter nor darker: left out",
    "bad_angle": "live events of an angle that is not 0, 45, 90 or 135: left out",
    "out_of_range": "events that are not on the sensor: left out",
    "stale": "first events on another clock, of the camera's last run: left out",
    "time_glitches": "events far from the time of those before and after them: left out",
    "unsorted": "events a little earlier than the one before: put in order",
    "late": "live events earlier than others that were used already: left out",
    "clock_resets": "times at which the clock of live input was set anew: events go on after 10 ms",
    "pauses": "pauses of a second or more between events: kept",
}
"""Kinds of damage that readers count. No event is ever given another time, pixel or polarity."""

SAFE = ("cut_tail", "no_change", "stale", "unsorted", "late", "clock_resets", "pauses")
"""Repairs allowed any number of times. A file with too many of another kind is refused."""


class RecordingError(ValueError):
    """A file cannot be read; the message gives the reason and a remedy."""


class Counts(Counter[str]):
    """Count of each kind of repair, and how far the file is read."""

    share_read = 0.0
    """0 to 1; 0 where the format does not tell."""


class Block(NamedTuple):
    """Events as stored in the file: columns of equal length and any number type."""

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    p: np.ndarray

    def rows(self, which: np.ndarray | slice) -> "Block":
        """Some of the events."""
        return Block(*(column[which] for column in self))


def joined(blocks: Sequence[Block]) -> Block:
    """One block of the events of at least one."""
    filled = [block for block in blocks if len(block.t)] or blocks[:1]
    return filled[0] if len(filled) == 1 else Block(*map(np.concatenate, zip(*filled, strict=True)))


def cut(blocks: Iterable[Block], size: int) -> Iterator[Block]:
    """The same events in blocks of `size`; the last block holds the remainder, also before a RecordingError."""
    waiting: list[Block] = []
    count, refusal = 0, None
    try:
        for block in blocks:
            waiting.append(block)
            count += len(block.t)
            if count >= size:
                whole, count = joined(waiting), count % size
                for start in range(0, len(whole.t) - size + 1, size):
                    yield whole.rows(slice(start, start + size))
                waiting = [whole.rows(slice(len(whole.t) - count, None))]
    except RecordingError as error:
        refusal = error
    if count:
        yield joined(waiting)
    if refusal is not None:
        raise refusal


@dataclass(frozen=True)
class Choices:
    """Properties of a file stated by the user; None where the file should state them."""

    height: int | None = None
    width: int | None = None
    part: str | None = None
    """A topic of a bag, a stream of AEDAT, or a camera of a file with two."""

    def part_of(self, file: str, parts: Sequence[str], words: str) -> str:
        """The part that the user names, or the only one; RecordingError that lists the parts otherwise."""
        if self.part in parts or (self.part is None and len(parts) == 1):
            return self.part or parts[0]
        listed = ", ".join(parts[:MAX_LISTED]) + (", ..." if len(parts) > MAX_LISTED else "")
        given = "" if self.part is None else f"; got {self.part!r}"
        raise RecordingError(f"{file}: say which {words} to read, --part with one of {listed or 'none'}{given}")

    def sensor_of(self, file: str, height: int | None, width: int | None) -> tuple[int, int]:
        """Height and width: those the file states, else those the user gave.

        RecordingError where neither states them, where both do and differ, or where the size is implausible.
        """
        for name, stated, given in (("height", height, self.height), ("width", width, self.width)):
            if None not in (stated, given) and stated != given:
                raise RecordingError(f"{file}: the file states a {name} of {stated} px, {given} was given; give none")
        height, width = self.height if height is None else height, self.width if width is None else width
        if height is None or width is None:
            raise RecordingError(f"{file}: the file does not say how large the sensor is; give --height and --width")
        if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
            raise RecordingError(f"{file}: expected a sensor with sides of 1 to {MAX_SIDE} px, got {height}x{width}")
        if height * width > MAX_PIXELS:
            raise RecordingError(f"{file}: expected a sensor of at most {MAX_PIXELS:,} pixels, got {height}x{width}")
        return height, width


Blocks = Callable[[Counts], Iterator[Block]]
"""Reads a file from its start, and counts the data it had to leave out."""


@dataclass(frozen=True)
class Source:
    """An opened file."""

    height: int | None
    """None if the file does not state the size."""
    width: int | None
    blocks: Blocks


class CameraFrames(NamedTuple):
    """Frames that a camera with a polarizer mosaic recorded beside its events, on the same clock."""

    t_us: np.ndarray
    """n times in microseconds, those of the middle of the exposure where the file gives it."""
    levels: np.ndarray | None
    """n x height x width code values, proportional to light: uint8, or uint16; None if the file has only maps."""
    maps: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    """S0 (1 at saturation), DoLP and AoLP (radians, [0, pi)), n x height/2 x width/2 each, if the file has them."""
