"""Raw files of Prophesee's cameras, EVT2 and EVT3: a header of lines that start with %, then words, little endian.

Both formats send the high bits of the time occasionally, and the low bits in between. A sensor's clock sometimes steps
back by some microseconds within the same high bits. Times are those of the words, regardless of earlier ones.
"""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, no_type_check

import numba
import numpy as np

from polarnet.recordings.source import Block, Choices, RecordingError, Source, sensor_size

LONGEST_HEADER = 2**16
BLOCK_WORDS = 2**17
MAX_PER_WORD = 12  # events per EVT3 word
SENSORS = {b"gen31": (480, 640), b"gen3": (480, 640), b"gen4": (720, 1280), b"imx636": (720, 1280),
           b"genx320": (320, 320)}  # fmt: skip
"""Height and width by the sensor's name in the header; files of 2020 state nothing else."""


class Header(NamedTuple):
    """Content of the header."""

    version: str
    height: int | None
    width: int | None
    start: int
    """Byte offset of the words."""


def matches(path: Path, head: bytes) -> bool:
    """Whether the header names an EVT format."""
    return head.startswith(b"% ") and (b"% evt " in head or b"% format EVT" in head)


def open_evt(path: Path, choices: Choices) -> Source:
    """Open the events of EVT2 or EVT3; the sensor's size comes from the header, or from the sensor's name there."""
    header = _header(path)
    height, width = sensor_size(path, choices, header.height, header.width)
    word, decode = {"2": ("<u4", _decode_2), "3": ("<u2", _decode_3)}[header.version]
    size = np.dtype(word).itemsize

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        state = np.array([-1, 0, 0, -1, 0, 0])  # high bits of the time, their wraps, low bits, y, base x, its polarity
        with path.open("rb") as file:
            file.seek(header.start)
            while data := file.read(BLOCK_WORDS * size):
                counts["cut_tail"] += len(data) % size != 0
                words = np.frombuffer(data[: len(data) // size * size], word)
                columns = [np.empty(MAX_PER_WORD * len(words), t) for t in (np.int64, np.int16, np.int16, np.int8)]
                found, orphans = decode(words, state, *columns)
                counts["orphans"] += int(orphans)
                yield Block(*(column[:found] for column in columns))

    return Source(height, width, blocks)


def _header(path: Path) -> Header:
    with path.open("rb") as file:
        data = file.read(LONGEST_HEADER)
    start = 0
    while data[start : start + 2] == b"% " and (end := data.find(b"\n", start)) >= 0:
        line, start = data[start:end].strip(), end + 1
        if line == b"% end":
            break
    header = data[:start]
    version = re.search(rb"% (?:evt |format EVT)(\d(?:\.\d)?)", header)
    number = version[1].decode().removesuffix(".0") if version else "none"
    if number not in ("2", "3"):
        raise RecordingError(f"{path.name}: expected a header of % lines that states EVT 2 or 3, got {number}")
    return Header(number, *_size(header), start)


def _size(header: bytes) -> tuple[int | None, int | None]:
    if found := re.search(rb"% geometry (\d{1,5})x(\d{1,5})", header):
        return int(found[2]), int(found[1])
    height, width = (re.search(name + rb"=(\d{1,5})", header) for name in (b"height", b"width"))
    if height and width:
        return int(height[1]), int(width[1])
    for name, size in SENSORS.items():
        if re.search(rb"(?i)% (plugin_name|sensor_name|generation)[^\n]*" + name, header):
            return size
    return None, None


@numba.njit(nogil=True, cache=True)
@no_type_check
def _decode_2(words, state, t, x, y, p):
    """Decode words by their upper 4 bits: 0 OFF, 1 ON, 8 the upper 28 bits of the time."""
    high, turns = state[0], state[1]
    found, orphans = 0, 0
    for i in range(len(words)):
        word = np.int64(words[i])
        kind = word >> 28
        if kind == 8:
            before, high = high, word & 0xFFFFFFF
            turns += before - high > 2**27
        elif kind <= 1:
            if high < 0:
                orphans += 1
                continue
            t[found] = ((turns << 28 | high) << 6) | (word >> 22 & 0x3F)
            x[found], y[found], p[found] = word >> 11 & 0x7FF, word & 0x7FF, kind
            found += 1
    state[0], state[1] = high, turns
    return found, orphans


@numba.njit(nogil=True, cache=True)
@no_type_check
def _decode_3(words, state, t, x, y, p):
    """Decode words by their upper 4 bits: 0 y, 2 x, 3 base x, 4 and 5 pixels after it, 6 and 8 the time."""
    high, turns, low, row, base, polarity = state
    found, orphans = 0, 0
    for i in range(len(words)):
        word = np.int64(words[i])
        kind, value = word >> 12, word & 0xFFF
        if kind == 6:
            low = value
        elif kind == 8:
            before, high = high, value
            turns += before - high > 2**11
            low = 0 if before != high else low
        elif kind == 0:
            row = value & 0x7FF
        elif kind == 3:
            base, polarity = value & 0x7FF, value >> 11
        elif kind == 2 or kind == 4 or kind == 5:
            if high < 0 or row < 0:
                orphans += 1
                continue
            now = (turns << 12 | high) << 12 | low
            if kind == 2:
                t[found], x[found], y[found], p[found] = now, value & 0x7FF, row, value >> 11
                found += 1
                continue
            pixels = 12 if kind == 4 else 8
            for k in range(pixels):
                if value >> k & 1:
                    t[found], x[found], y[found], p[found] = now, base + k, row, polarity
                    found += 1
            base = min(base + pixels, 2048)  # outside every sensor; larger values would not fit into int16
    state[:] = high, turns, low, row, base, polarity
    return found, orphans
