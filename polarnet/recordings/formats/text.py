"""Lines `t x y p`: what E2VID, ESIM and numpy write; also with commas."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polarnet.recordings.formats.lines import HEAD_BYTES, number_blocks, numbers_of
from polarnet.recordings.source import Block, Choices, RecordingError, Source, sensor_size

COLUMNS = ("t", "x", "y", "p")
MICROSECONDS = 6  # decimals of a second


def matches(path: Path, head: bytes) -> bool:
    """Whether the first line of numbers is `width height`, or four numbers of which the last is a polarity."""
    lines = numbers_of(head)
    if not lines:
        return not head.strip()
    words = lines[0].words
    return len(words) == 2 or (len(words) == 4 and all(float(line.words[-1]) in (-1, 0, 1) for line in lines))


def open_text(path: Path, choices: Choices) -> Source:
    """Lines `t x y p`, under a line `width height` or with the size given; # starts a comment.

    t is in seconds where the first event's t has a decimal point, else in microseconds; p is 1 or 0, or 1 or -1.
    """
    with path.open("rb") as file:
        lines = numbers_of(file.read(HEAD_BYTES))
    height = width = None
    start = 0
    if lines and len(lines[0].words) == 2:
        (width, height), start = _size(path, lines[0].words), lines[0].end
        del lines[0]
    height, width = sensor_size(path, choices, height, width)
    columns = len(lines[0].words) if lines else len(COLUMNS)
    if columns != len(COLUMNS):
        raise RecordingError(f"{path.name}: expected lines of the four columns t x y p, got {columns} columns")
    seconds = bool(lines) and "." in lines[0].words[0]

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        for rows in number_blocks(path, (MICROSECONDS if seconds else 0, 0, 0, 0), start, counts):
            yield Block(*(np.ascontiguousarray(column) for column in rows.T))

    return Source(height, width, blocks)


def _size(path: Path, words: list[str]) -> tuple[int, int]:
    try:
        return int(words[0]), int(words[1])
    except ValueError:
        raise RecordingError(f"{path.name}: expected a first line `width height`, got {' '.join(words)!r}") from None
