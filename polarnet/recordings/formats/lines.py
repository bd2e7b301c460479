"""Lines of decimal numbers as columns of whole numbers, at disk speed and in blocks.

The format `text` has lines `t x y p`, as written by E2VID, ESIM, v2e and numpy, or `x,y,p,t`, as written by Prophesee's
tools. Lines that begin with # or % are comments.
"""

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from polarnet.recordings.content import byte_blocks, start_of, unpacked
from polarnet.recordings.source import BLOCK_EVENTS, Block, Choices, Counts, RecordingError, Source
from polarnet.runtime.compilation import compiled

HEAD_BYTES = 4096  # bytes at the start of a file; enough for every format to recognise its own
BLOCK_BYTES = 2**22
MAX_LINE = 2**12  # bytes

COLUMNS = ("t", "x", "y", "p")
PROPHESEE = ("x", "y", "p", "t")
NAMES = {
    **dict.fromkeys(("time", "times", "timestamp", "timestamps", "ts", "t_us", "ts_us", "timestamp_us"), "t"),
    **dict.fromkeys(("xs", "col", "column"), "x"),
    **dict.fromkeys(("ys", "row"), "y"),
    **dict.fromkeys(("ps", "pol", "polarity", "polarities", "on"), "p"),
}
BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # at the start of text that Windows wrote
MICROSECONDS = 6  # decimals of a second
TELLING_TIMES = 4  # different times that tell seconds from microseconds
MAX_SEARCHED = 2**20  # lines searched for them: a simulated camera's first events may all be at time 0

_SEPARATORS, _COMMENT = re.compile(rb"[,;\s]+"), re.compile(rb"[#%]")
_NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|(?i:true|false)")
_POLARITY = re.compile(r"[+-]?[01](\.0*)?(e[+-]?0+)?|(?i:true|false)")
_GEOMETRY = re.compile(rb"(?m)^[#%]\s*geometry\W+(\d{1,5})\D(\d{1,5})")
_DIGITS = 18  # decimal digits that always fit into int64; further ones are less than a microsecond
_POWERS = 10 ** np.arange(_DIGITS + 1)
_MAX_VALUE = 2**60
_LIMITS = _MAX_VALUE // _POWERS  # of a number that is multiplied by that power
_END, _SEPARATOR_CODE, _COMMENT_CODE = 10, 1, 2  # line feed; values of _KINDS
_KINDS = np.zeros(256, np.uint8)  # of a byte: 0 for a part of a number
_KINDS[list(b" ,;\t\r\n")], _KINDS[list(b"#%")] = _SEPARATOR_CODE, _COMMENT_CODE


def matches_text(path: Path, head: bytes) -> bool:
    """Whether the first lines name the columns or say `width height`, or are four numbers with a polarity."""
    return _layout_of(head)[0] is not None


def open_text(path: Path, choices: Choices) -> Source:
    """Open lines of events, after a line `width height` or with the given size; # and % start a comment.

    The order is that of a line of names. Without one it is t x y p, or x y p t if only the third column is a polarity.
    t is in seconds if one of the first four different times has a fraction, else in microseconds. p is 1 or 0, 1 or
    -1, or True or False.
    """
    order, start, size, columns = _layout_of(start_of(path, HEAD_BYTES))
    if columns != len(COLUMNS):
        raise RecordingError(f"{path.name}: expected lines of the four columns t x y p, got {columns} columns")
    if not all(word.isdigit() for word in size):
        raise RecordingError(f"{path.name}: expected a first line `width height`, got {' '.join(size)!r}")
    if order is not None and sorted(order) != sorted(COLUMNS):
        raise RecordingError(
            f"{path.name}: expected the names t, x, y, p of columns, or such as timestamp, polarity, row, column, got "
            f"{', '.join(order)}; rename them"
        )
    width, height = map(int, size) if size else (None, None)
    order = order or COLUMNS
    decimals = [0] * len(order)
    decimals[order.index("t")] = MICROSECONDS if _in_seconds(path, start, order.index("t")) else 0

    def blocks(counts: Counts) -> Iterator[Block]:
        for rows in number_blocks(path, tuple(decimals), start, counts):
            yield Block(*(np.ascontiguousarray(rows[:, order.index(name)]) for name in COLUMNS))

    return Source(height, width, blocks)


def _layout_of(head: bytes) -> tuple[tuple[str, ...] | None, int, Sequence[str], int]:
    """Names of the columns (None: no lines of events), offset of the first event, width and height, column count."""
    geometry = _GEOMETRY.search(head)
    size: Sequence[str] = [side.decode() for side in geometry.groups()] if geometry else []
    order, start = _names(head)
    lines = numbers_of(head[start:])
    if lines and len(lines[0].words) == 2:
        (size, end), *lines = lines
        start += end
    if order is None:
        order = _order_of([line.words for line in lines])
    if order is None and (size or not head.strip()):
        order = COLUMNS
    return order, start, size, len(lines[0].words) if lines else len(COLUMNS)


def _names(head: bytes) -> tuple[tuple[str, ...] | None, int]:
    """Column order from a line of names before the numbers, and the next line's offset; None and 0 without one.

    Four names before four numbers may be unknown.
    """
    place = 0
    for line in head.splitlines(keepends=True):
        place += len(line)
        words = words_of(line.lower().strip(b" #%\r\n\t\xef\xbb\xbf").replace(b'"', b""))
        order = tuple(NAMES.get(word, word) for word in (one.decode("ascii", "replace") for one in words))
        if sorted(order) == sorted(COLUMNS):
            return order, place
        if words and line.lstrip()[:1] not in (b"#", b"%"):
            named = len(words) == len(COLUMNS) and not any(map(_NUMBER.fullmatch, words))
            if named and (first := numbers_of(head[place:])[:1]) and len(first[0].words) == len(COLUMNS):
                return order, place
            break
    return None, 0


def _order_of(lines: Sequence[Sequence[str]]) -> tuple[str, ...] | None:
    """The order whose column of polarities holds mostly polarities."""
    fours = [words for words in lines if len(words) == len(COLUMNS)]
    for order in (COLUMNS, PROPHESEE):
        place = order.index("p")
        if 2 * sum(bool(_POLARITY.fullmatch(words[place])) for words in fours) > len(lines):
            return order
    return None


def _in_seconds(path: Path, start: int, place: int) -> bool:
    """Whether times are in seconds: an early one has a fraction, or they are few and one has a point."""
    times: dict[float, bytes] = {}
    with unpacked(path) as file:
        file.seek(start)
        for line in itertools.islice(iter(lambda: file.readline(MAX_LINE), b""), MAX_SEARCHED):
            word = words[place] if len(words := words_of(line)) == len(COLUMNS) else b""
            if word.isalpha() or not _NUMBER.fullmatch(word) or not abs(float(word)) < _MAX_VALUE:
                continue
            time = float(word)
            times.setdefault(time, word)
            if not time.is_integer() or len(times) == TELLING_TIMES:
                return not time.is_integer()
    return any(b"." in word and b"e" not in word.lower() for word in times.values())


def number_blocks(
    path: Path, decimals: tuple[int, ...], skip_bytes: int, counts: Counts
) -> Iterator[Int64[np.ndarray, "n columns"]]:
    """Read the lines of a file from byte `skip_bytes` as rows of len(decimals) whole numbers.

    Column i is multiplied by 10**decimals[i]. Where decimals[i] > 0 the rest is rounded; elsewhere a fraction makes the
    line unreadable. True is 1 and False 0. Numbers are separated by blanks, commas or semicolons; # and % start a
    comment. Unreadable lines are left out and counted as `unreadable_lines`, but one at the end without a line feed as
    `cut_tail`.
    """
    shift = np.array(decimals, np.int64)
    rest = b""
    for block in byte_blocks(path, skip_bytes, BLOCK_BYTES, counts):
        data = rest + block
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
        words = words_of(line)
        if words and all(map(_NUMBER.fullmatch, words)):
            numbers.append(Line([word.decode() for word in words], place))
        elif words:
            others += 1
    return numbers if len(numbers) >= others else []


def words_of(line: bytes) -> list[bytes]:
    """The words between blanks, commas and semicolons, before a comment."""
    line = line.removeprefix(BYTE_ORDER_MARK)
    return [word for word in _SEPARATORS.split(_COMMENT.split(line, 1)[0]) if word]


def rows_of(
    data: bytes, shift: Int64[np.ndarray, " columns"], counts: Counts, damage: str
) -> Iterator[Int64[np.ndarray, "n columns"]]:
    """Parse complete lines to rows of numbers, as in `number_blocks`; other lines are counted as `damage`."""
    buffer = np.frombuffer(data, np.uint8)
    start = 0
    while start < len(buffer):
        rows = np.empty((len(shift), BLOCK_EVENTS), np.int64).T  # so that each column is contiguous
        filled, start, unreadable = _parse(buffer, start, shift, rows)
        counts[damage] += unreadable
        if filled:
            yield rows[:filled]


def lines_of(table: Int64[np.ndarray, "n columns"], separator: str) -> bytes:
    """Format whole numbers as lines of text."""
    row = separator.join(["%d"] * table.shape[1]) + "\n"
    return "".join([row % tuple(values) for values in table.tolist()]).encode()


@compiled
def _parse(buffer, start, shift, rows):
    """Fill `rows` from the lines at `start`; returns the number filled, the next offset and the number unreadable."""
    place, filled, unreadable = start, 0, 0
    size, columns = len(buffer), len(shift)
    while place < size and filled < len(rows):
        column, good = 0, True
        while place < size and buffer[place] != _END:
            kind = _KINDS[buffer[place]]
            if kind == _COMMENT_CODE:
                while place < size and buffer[place] != _END:
                    place += 1
            elif kind == _SEPARATOR_CODE:
                place += 1
            else:
                missing = shift[column] if column < columns else 0
                value, end, most = 0, place, min(size, place + _DIGITS - 1)  # first the common case: digits
                while end < most and 48 <= buffer[end] <= 57:
                    value = 10 * value + buffer[end] - 48
                    end += 1
                whole = place < end < most
                if whole and missing > 0 and buffer[end] == 46:  # ... maybe with a point
                    end += 1
                    while end < most and missing > 0 and 48 <= buffer[end] <= 57:
                        value = 10 * value + buffer[end] - 48
                        end += 1
                        missing -= 1
                if whole and end < most and _KINDS[buffer[end]] and value < _LIMITS[missing]:
                    value, place = value * _POWERS[missing], end
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


@compiled
def _number(buffer, place, shift):
    """Parse the number at `place`, times 10**shift; returns it, its end, and whether it is valid."""
    size, start = len(buffer), place
    letter = buffer[place] | 32
    if letter == 116 or letter == 102:  # True or False
        while place < size and not _KINDS[buffer[place]]:
            place += 1
        return np.int64(letter == 116), place, shift == 0 and place - start == (4 if letter == 116 else 5)
    negative = buffer[place] == 45
    place += negative or buffer[place] == 43
    value, digits, count, exponent, point = np.int64(0), 0, 0, shift, False
    while place < size:
        digit = np.int64(buffer[place]) - 48
        if 0 <= digit <= 9:
            count += 1
            if digits < _DIGITS:
                value = 10 * value + digit
                digits += int(value > 0)
                exponent -= point
            else:
                exponent += not point
        elif digit == -2 and not point:
            point = True
        else:
            break
        place += 1
    good = count > 0
    if place < size and buffer[place] | 32 == 101:  # an exponent
        place += 1
        sign = -1 if place < size and buffer[place] == 45 else 1
        place += place < size and (buffer[place] == 45 or buffer[place] == 43)
        power, first = 0, place
        while place < size and 48 <= buffer[place] <= 57:
            power = min(10 * power + (buffer[place] - 48), 1000)
            place += 1
        good = good and place > first
        exponent += sign * power
    if exponent > 0 and value:
        good = good and exponent <= _DIGITS and value < _LIMITS[min(exponent, _DIGITS)]
        value *= _POWERS[min(exponent, _DIGITS)]
    elif exponent < 0 and value:
        unit = _POWERS[min(-exponent, _DIGITS)] if exponent >= -_DIGITS else _MAX_VALUE * 4
        good = good and (shift > 0 or value % unit == 0)
        value = value // unit + (value % unit >= unit - unit // 2)
    good = good and (place == size or _KINDS[buffer[place]])
    while place < size and not _KINDS[buffer[place]]:
        place += 1
    return -value if negative else value, place, good
