"""The interface of a file format's module: an opened file that yields its columns in blocks, unchanged."""

import contextlib
import gzip
import itertools
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from polarnet.events.stream import MAX_SIDE
from polarnet.runtime.compilation import compiled

BLOCK_EVENTS = 2**18  # events that a format decodes at a time; chunks handed to a user are cut anew

MAX_LISTED = 16  # parts of a recording in a message
MAX_PIXELS = 2**24  # of a sensor; the largest event cameras have 1.3 million

WRAP_US = 2**32  # range of 32-bit time stamps
FOLLOWING = 8  # events that tell a wrap of the time stamps from one wrong stamp

GZIP, ZIP = b"\x1f\x8b", b"PK\x03\x04"

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
    return blocks[0] if len(blocks) == 1 else Block(*map(np.concatenate, zip(*blocks, strict=True)))


@dataclass(frozen=True)
class Choices:
    """Properties of a file stated by the user; None where the file should state them."""

    height: int | None = None
    width: int | None = None
    part: str | None = None
    """A topic of a bag, a stream of AEDAT, or a camera of a file with two."""


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


@contextlib.contextmanager
def unpacked(path: Path) -> Iterator[Any]:
    """The binary content of a file, or of the one file in a gzip or zip archive; RecordingError for other archives."""
    with contextlib.ExitStack() as stack:
        file: Any = stack.enter_context(path.open("rb"))
        magic = file.read(len(ZIP))
        file.seek(0)
        try:
            if magic.startswith(GZIP):
                file = stack.enter_context(gzip.open(file))
            elif magic == ZIP:
                archive = zipfile.ZipFile(file)
                every = [one for one in archive.infolist() if not one.is_dir()]
                members = [one for one in every if not Path(one.filename).name.startswith(".")]  # as macOS adds
                if len(members) != 1:
                    raise RecordingError(
                        f"{path.name}: expected one recording in the zip archive, got {len(members)} files; unpack it"
                    )
                file = stack.enter_context(archive.open(members[0]))
            yield file
        except (EOFError, zlib.error, gzip.BadGzipFile, zipfile.BadZipFile, RuntimeError) as error:
            raise RecordingError(f"{path.name}: the archive cannot be unpacked: {error}") from error


def byte_blocks(path: Path, start: int, size: int, counts: Counts) -> Iterator[bytearray]:
    """The content from byte `start` on, unpacked, `size` bytes at a time; a cut archive is counted as `cut_tail`."""
    with unpacked(path) as file:
        block, on_disk = bytearray(), getattr(file, "fileobj", file)  # of gzip, the packed file
        try:
            file.seek(start)
            while data := file.read1(size - len(block)):
                block += data
                if len(block) == size:
                    counts.share_read = min(1.0, on_disk.tell() / path.stat().st_size)
                    yield block
                    block = bytearray()
        except EOFError:
            counts["cut_tail"] += 1
        if block:
            yield block


def start_of(path: Path, size: int) -> bytes:
    """The first bytes of a file, unpacked."""
    return bytes(next(byte_blocks(path, 0, size, Counts()), b""))


def word_blocks(path: Path, start: int, dtype: np.dtype | str, words: int, counts: Counts) -> Iterator[np.ndarray]:
    """The words of a file from byte `start` on, `words` at a time; a cut word at the end is counted as `cut_tail`."""
    size = np.dtype(dtype).itemsize
    for data in byte_blocks(path, start, words * size, counts):
        counts["cut_tail"] += len(data) % size != 0
        if len(data) >= size:
            yield np.frombuffer(data, dtype, len(data) // size)


def header_lines(path: Path, prefix: bytes, last: bytes, max_bytes: int) -> tuple[bytes, bytes, bool]:
    """First lines of a file that begin with `prefix`, the two bytes after them, and whether `last` ends them."""
    data = start_of(path, max_bytes)
    start, ended = 0, False
    while not ended and data.startswith(prefix, start) and (end := data.find(b"\n", start)) >= 0:
        ended = data[start:end].strip() == last
        start = end + 1
    return data[:start], data[start : start + 2], ended


def unwrapped(blocks: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Unwrapped times (int64) and entries of each block that is not empty; column `t` has 32-bit microseconds.

    A stamp on the other side of the range is a wrap if most of the events after it are there too. Otherwise it is one
    late or wrong stamp, and later times do not change.
    """
    state = None
    for block, following in itertools.pairwise(itertools.chain((one for one in blocks if len(one)), [None])):
        assert block is not None
        after = block["t"][:0] if following is None else following["t"][:FOLLOWING]
        t = np.concatenate([block["t"], after]).astype(np.int64)
        state = np.array([0, np.median(t[: FOLLOWING + 1])], np.int64) if state is None else state
        _unwrap(t, len(block), state)
        yield t[: len(block)], block


@compiled
def _unwrap(t, count, state):
    """Add the wraps to the first `count` times; `state` holds the wraps and the last credible stamp."""
    wraps, before = state
    for i in range(count):
        now = t[i]
        step = now - before
        wrap = 0
        if abs(step) > WRAP_US // 2:
            wrap = -1 if step > 0 else 1
            after = t[i + 1 : i + 1 + FOLLOWING]
            agree = np.sum(np.abs(after - before) > WRAP_US // 2)
            if 2 * agree < len(after):
                t[i] += (wraps + wrap) * WRAP_US
                continue
            wrap = max(wrap, 0)  # forwards, it is a pause
        wraps += wrap
        before = now
        t[i] += wraps * WRAP_US
    state[0], state[1] = wraps, before


def chosen_part(path: Path, part: str | None, parts: Sequence[str], words: str) -> str:
    """The part of a recording that the user names, or the only one; RecordingError that lists the parts otherwise."""
    if part in parts or (part is None and len(parts) == 1):
        return part or parts[0]
    listed = ", ".join(parts[:MAX_LISTED]) + (", ..." if len(parts) > MAX_LISTED else "")
    given = "" if part is None else f"; got {part!r}"
    raise RecordingError(f"{path.name}: say which {words} to read, --part with one of {listed or 'none'}{given}")


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
        raise RecordingError(f"{path.name}: the file does not say how large the sensor is; give --height and --width")
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
        raise RecordingError(f"{path.name}: expected a sensor with sides of 1 to {MAX_SIDE} px, got {height}x{width}")
    if height * width > MAX_PIXELS:
        raise RecordingError(f"{path.name}: expected a sensor of at most {MAX_PIXELS:,} pixels, got {height}x{width}")
    return height, width
