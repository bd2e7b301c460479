"""The interface of a file format's module: an opened file that yields its columns in blocks, unchanged."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from polarnet.events.stream import MAX_SIDE

BLOCK_EVENTS = 2**18  # events that a format decodes at a time; chunks handed to a user are cut anew

MAX_PIXELS = 2**24  # of a sensor; the largest event cameras have 1.3 million

WRAP_US = 2**32  # range of 32-bit time stamps

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
    return blocks[0] if len(blocks) == 1 else Block(*map(np.concatenate, zip(*blocks, strict=True)))


@dataclass(frozen=True)
class Choices:
    """Properties of a file stated by the user; None where the file should state them."""

    height: int | None = None
    width: int | None = None
    part: str | None = None
    """SEQUENCE/ANGLE of an event store, or a topic of a bag."""
    clock_mhz: float | int | None = None
    """Clock of a CeleX-5; None: 100 MHz in a BIN file, and times in microseconds in a CSV file."""


@dataclass(frozen=True)
class Source:
    """An opened file. `blocks(counts)` reads it from the start and counts the data it had to leave out."""

    height: int
    width: int
    blocks: Callable[[Counter[str]], Iterator[Block]]


class CameraFrames(NamedTuple):
    """Frames that a camera with a polarizer mosaic recorded beside its events, on the same clock."""

    t_us: np.ndarray
    """n times in microseconds, those of the middle of the exposure where the file gives it."""
    levels: np.ndarray | None
    """n x height x width code values, proportional to light: uint8, or uint16; None if the file has only maps."""
    maps: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    """S0 (1 at saturation), DoLP and AoLP (radians, [0, pi)), n x height/2 x width/2 each, if the file has them."""


def word_blocks(
    path: Path, start: int, dtype: np.dtype | str, words: int, counts: Counter[str]
) -> Iterator[np.ndarray]:
    """The words of a file from byte `start` on, `words` at a time; a cut word at the end is counted as `cut_tail`."""
    size = np.dtype(dtype).itemsize
    with path.open("rb") as file:
        file.seek(start)
        while data := file.read(words * size):
            counts["cut_tail"] += len(data) % size != 0
            if len(data) >= size:
                yield np.frombuffer(data[: len(data) // size * size], dtype)


def header_lines(path: Path, prefix: bytes, last: bytes, max_bytes: int) -> tuple[bytes, bytes, bool]:
    """First lines of a file that begin with `prefix`, the two bytes after them, and whether `last` ends them."""
    with path.open("rb") as file:
        data = file.read(max_bytes)
    start, ended = 0, False
    while not ended and data.startswith(prefix, start) and (end := data.find(b"\n", start)) >= 0:
        ended = data[start:end].strip() == last
        start = end + 1
    return data[:start], data[start : start + 2], ended


def unwrapped(blocks: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Unwrapped times (int64) and entries of each block that is not empty; column `t` has 32-bit microseconds."""
    turns, before = 0, 0
    for block in blocks:
        if len(block):
            t = block["t"].astype(np.int64)
            wraps = turns + np.cumsum(np.diff(t, prepend=before) < -WRAP_US // 2)
            turns, before = int(wraps[-1]), int(t[-1])
            yield t + wraps * WRAP_US, block


def sensor_size(path: Path, choices: Choices, height: int | None = None, width: int | None = None) -> tuple[int, int]:
    """Height and width: those the file states, else those the user gave.

    RecordingError where neither states them, where both do and differ, or where the size is implausible.
    """
    for name, stated, given in (("height", height, choices.height), ("width", width, choices.width)):
        if stated is not None and given is not None and stated != given:
            raise RecordingError(f"{path.name}: the file states a {name} of {stated} px, {given} was given; give none")
    height = choices.height if height is None else height
    width = choices.width if width is None else width
    if height is None or width is None:
        raise RecordingError(f"{path.name}: the file does not say how large the sensor is; give height and width")
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
        raise RecordingError(f"{path.name}: expected a sensor with sides of 1 to {MAX_SIDE} px, got {height}x{width}")
    if height * width > MAX_PIXELS:
        raise RecordingError(f"{path.name}: expected a sensor of at most {MAX_PIXELS:,} pixels, got {height}x{width}")
    return height, width
