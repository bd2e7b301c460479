"""Lines `t x y p`, as written by E2VID, ESIM and numpy; commas are accepted too."""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polarnet.recordings.formats.lines import HEAD_BYTES, number_blocks, numbers_of
from polarnet.recordings.source import Block, Choices, RecordingError, Source, sensor_size

COLUMNS = ("t", "x", "y", "p")
NAMES = {"time": "t", "timestamp": "t", "ts": "t", "pol": "p", "polarity": "p", "on": "p"}
MICROSECONDS = 6  # decimals of a second


def matches(path: Path, head: bytes) -> bool:
    """Whether the first line names the columns, is `width height`, or is four numbers, the last mostly a polarity."""
    if _names(head)[1]:
        return True
    lines = numbers_of(head)
    if not lines:
        return not head.strip()
    words = lines[0].words
    polarities = sum(float(line.words[-1]) in (-1, 0, 1) for line in lines)
    return len(words) == 2 or (len(words) == len(COLUMNS) and 2 * polarities > len(lines))


def open_text(path: Path, choices: Choices) -> Source:
    """Open lines `t x y p`, after a line `width height` or with the given size; # starts a comment.

    A first line of names may give another order of the columns. t is in seconds where the first event's t has a decimal
    point, else in microseconds; p is 1 or 0, or 1 or -1.
    """
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    lines = numbers_of(head)
    height = width = None
    order, start = _names(head)
    if lines and len(lines[0].words) == 2:
        (width, height), start = _size(path, lines[0].words), lines[0].end
        del lines[0]
    height, width = sensor_size(path, choices, height, width)
    columns = len(lines[0].words) if lines else len(COLUMNS)
    if columns != len(COLUMNS):
        raise RecordingError(f"{path.name}: expected lines of the four columns t x y p, got {columns} columns")
    place = order.index("t")
    seconds = bool(lines) and "." in lines[0].words[place]
    decimals = tuple(MICROSECONDS if seconds and name == "t" else 0 for name in order)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        for rows in number_blocks(path, decimals, start, counts):
            yield Block(*(np.ascontiguousarray(rows[:, order.index(name)]) for name in COLUMNS))

    return Source(height, width, blocks)


def _names(head: bytes) -> tuple[tuple[str, ...], int]:
    """Column order from the names in the first line, and the next line's offset; t x y p if there are no names."""
    line = head.split(b"\n", 1)[0]
    words = re.split(r"[,;\s]+", line.decode("ascii", "replace").lower().strip(" #\r\t\ufeff"))
    order = tuple(NAMES.get(word, word) for word in words)
    return (order, len(line) + 1) if sorted(order) == sorted(COLUMNS) else (COLUMNS, 0)


def _size(path: Path, words: list[str]) -> tuple[int, int]:
    try:
        return int(words[0]), int(words[1])
    except ValueError:
        raise RecordingError(f"{path.name}: expected a first line `width height`, got {' '.join(words)!r}") from None
