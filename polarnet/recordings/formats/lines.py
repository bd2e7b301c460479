"""Lines of decimal numbers as columns of whole numbers, at disk speed and in blocks.

The format `text` has lines `t x y p`, as written by E2VID, ESIM and numpy; commas are accepted too.
"""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Int64

from polarnet.recordings.source import BLOCK_EVENTS, Block, Choices, RecordingError, Source, sensor_size

HEAD_BYTES = 4096  # bytes at the start of a file; enough for every format to recognise its own
BLOCK_BYTES = 2**22
MAX_LINE = 2**12  # bytes

COLUMNS = ("t", "x", "y", "p")
NAMES = {"time": "t", "timestamp": "t", "ts": "t", "pol": "p", "polarity": "p", "on": "p"}
MICROSECONDS = 6  # decimals of a second

_SEPARATORS = re.compile(rb"[,;]")
_NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_DIGITS = 18  # decimal digits that always fit into int64; further ones are less than a microsecond
_MAX_VALUE = 2**60
_END, _COMMENT = 10, 35  # line feed, #


def matches_text(path: Path, head: bytes) -> bool:
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
        (size, start), *lines = lines
        if not all(word.isdigit() for word in size):
            raise RecordingError(f"{path.name}: expected a first line `width height`, got {' '.join(size)!r}")
        width, height = map(int, size)
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


def number_blocks(
    path: Path, decimals: tuple[int, ...], skip_bytes: int, counts: Counter[str]
) -> Iterator[Int64[np.ndarray, "n columns"]]:
    """Read the lines of a file from byte `skip_bytes` as rows of len(decimals) whole numbers.

    Column i is multiplied by 10**decimals[i]. Where decimals[i] > 0 the rest is rounded; elsewhere a fraction makes the
    line unreadable. Numbers are separated by blanks, commas or semicolons; # starts a comment. Unreadable lines are
    left out and counted as `unreadable_lines`, but one at the end without a line feed as `cut_tail`.
    """
    shift = np.array(decimals, np.int64)
    with path.open("rb") as file:
        file.seek(skip_bytes)
        rest = b""
        while data := file.read(BLOCK_BYTES):
            data = rest + data
            end = data.rfind(b"\n") + 1
            rest = data[end:]
            if len(rest) > MAX_LINE:
                raise RecordingError(
                    f"{path.name}: expected lines of numbers, got {len(rest)} bytes without the end of a line"
                )
            yield from rows_of(data[:end], shift, counts, "unreadable_lines")
        yield from rows_of(rest, shift, counts, "cut_tail")


class Line(NamedTuple):
    """A line of numbers at the head of a file."""

    words: list[str]
    end: int
    """Byte offset of the next line in the file."""


def numbers_of(head: bytes) -> list[Line]:
    """The lines of numbers among the first bytes of a file; empty if most lines are something else."""
    numbers: list[Line] = []
    others, place = 0, 0
    for line in head.splitlines(keepends=True):
        place += len(line)
        if len(line) == len(head) > MAX_LINE // 2 or (place == len(head) and numbers and not line.endswith(b"\n")):
            break  # cut off at the end of the head
        words = _SEPARATORS.sub(b" ", line.split(b"#")[0]).split()
        if words and all(map(_NUMBER.fullmatch, words)):
            numbers.append(Line([word.decode() for word in words], place))
        elif words:
            others += 1
    return numbers if len(numbers) >= others else []


def rows_of(
    data: bytes, shift: Int64[np.ndarray, " columns"], counts: Counter[str], damage: str
) -> Iterator[Int64[np.ndarray, "n columns"]]:
    """Parse complete lines to rows of numbers, as in `number_blocks`; other lines are counted as `damage`."""
    buffer = np.frombuffer(data, np.uint8)
    start = 0
    while start < len(buffer):
        rows = np.empty((BLOCK_EVENTS, len(shift)), np.int64)
        filled, start, unreadable = _parse(buffer, start, shift, rows)
        counts[damage] += unreadable
        if filled:
            yield rows[:filled]


def lines_of(table: Int64[np.ndarray, "n columns"], separator: str) -> bytes:
    """Format whole numbers as lines of text."""
    row = separator.join(["%d"] * table.shape[1]) + "\n"
    return "".join([row % tuple(values) for values in table.tolist()]).encode()


@numba.njit(nogil=True, cache=True)
@no_type_check
def _parse(buffer, start, shift, rows):
    """Fill `rows` from the lines at `start`; returns the number filled, the next offset and the number unreadable."""
    place, filled, unreadable = start, 0, 0
    size, columns = len(buffer), len(shift)
    while place < size and filled < len(rows):
        column, good = 0, True
        while place < size and buffer[place] != _END:
            code = buffer[place]
            if code == _COMMENT:
                while place < size and buffer[place] != _END:
                    place += 1
            elif _ends(code):
                place += 1
            else:
                value, place, whole = _number(buffer, place, shift[column] if column < columns else 0)
                good = good and whole
                if column < columns:
                    rows[filled, column] = value
                column += 1
        place += 1
        if good and column == columns:
            filled += 1
        elif column:
            unreadable += 1
    return filled, place, unreadable


@numba.njit(nogil=True, cache=True)
@no_type_check
def _number(buffer, place, shift):
    """Parse the number at `place`, times 10**shift; returns it, its end, and whether it is valid."""
    size, start = len(buffer), place
    negative = buffer[place] == 45
    place += negative
    value, first = 0, place
    while place < size and 48 <= buffer[place] <= 57 and place - first < _DIGITS:
        value = 10 * value + (buffer[place] - 48)
        place += 1
    if shift == 0 and place > first and (place == size or _ends(buffer[place])):
        return -value if negative else value, place, True
    place = start + (negative or buffer[start] == 43)
    value, digits, count, exponent, point = 0, 0, 0, shift, False
    while place < size:
        code = buffer[place]
        if 48 <= code <= 57:
            count += 1
            if digits < _DIGITS:
                value = 10 * value + (code - 48)
                digits += value > 0
                exponent -= point
            else:
                exponent += not point
        elif code == 46 and not point:
            point = True
        else:
            break
        place += 1
    good = count > 0
    if place < size and (buffer[place] == 101 or buffer[place] == 69):
        place += 1
        sign = -1 if place < size and buffer[place] == 45 else 1
        place += place < size and (buffer[place] == 45 or buffer[place] == 43)
        power, first = 0, place
        while place < size and 48 <= buffer[place] <= 57:
            power = min(10 * power + (buffer[place] - 48), 1000)
            place += 1
        good = good and place > first
        exponent += sign * power
    while exponent > 0 and value != 0 and good:
        good = value < _MAX_VALUE // 10
        value, exponent = 10 * value, exponent - 1
    tenths = 0
    while exponent < 0 and value != 0:
        good = good and (shift > 0 or value % 10 == 0)
        tenths = value % 10
        value, exponent = value // 10, exponent + 1
    value += tenths >= 5
    good = good and value < _MAX_VALUE
    while place < size and not _ends(buffer[place]):
        good = False
        place += 1
    return -value if negative else value, place, good


@numba.njit(nogil=True, cache=True, inline="always")
@no_type_check
def _ends(code):
    return code in (32, 44, 59, 9, 13, _END, _COMMENT)
