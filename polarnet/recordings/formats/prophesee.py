"""Files of Prophesee's cameras, little endian: EVT2, EVT2.1, EVT3 (raw) and DAT. Each begins with lines of %.

EVT sends the high bits of the time occasionally, and the low bits in between. A sensor's clock sometimes steps back by
some microseconds within the same high bits; its events keep their earlier times. DAT has 8 bytes per event.

EVT2.1 exists in two byte orders: `little`, and `legacy` of the cameras up to the IMX647, whose 32-bit halves are
exchanged. As in Prophesee's OpenEB, the header states the order, and where it does not, the camera's system ID does.
"""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from polarnet.recordings.content import header_lines, unwrapped, word_blocks
from polarnet.recordings.source import BLOCK_EVENTS, Block, Choices, Counts, RecordingError, Source
from polarnet.runtime.compilation import compiled

PREFIX, LAST_LINE = b"% ", b"% end"
MAX_HEADER_BYTES = 2**16
EVT_BLOCK_WORDS = 2**17
SENSORS = {
    (480, 640): (b"gen3", b"3", (21, 23, 25, 28, 29, 33, 34, 35, 40, 41)),
    (720, 1280): (b"gen4|imx6", b"4", (26, 30, 31, 32, 39, 46, 48, 49, 50, 52, 53, 54, 58, 66)),
    (320, 320): (b"genx320", b"none", (59, 64)),
}
"""Sensors' names, generation and cameras' system IDs (as in OpenEB) by height and width, in headers of EVT."""
FIRST_LITTLE_ENDIAN = 55  # system ID of the EVK2 that came after those with exchanged halves
DAT_EVENT = np.dtype([("t", "<u4"), ("address", "<u4")])
CHANGE_DETECTION = (0, 12)  # DAT's types of events: 2D of the first sensors, CD of the later ones

LOW, HIGH, HIGH_AND_LOW, ROW, BASE, PIXEL, NOTHING = range(-7, 0)
"""Kinds of 16-bit words: bits of the time (HIGH_AND_LOW: the low ones are 0 after a change), the next events' y, x of
the next mask, x of an event. Positive kinds are masks of that many pixels."""
EVT3_KINDS = np.array([ROW, NOTHING, PIXEL, BASE, 12, 8, LOW, NOTHING, HIGH_AND_LOW, *[NOTHING] * 7])
LIBCAER_KINDS = np.array([HIGH, LOW, ROW, PIXEL, BASE, 8, *[NOTHING] * 10])  # with x and y exchanged
EVT_START = -1, 0, 0, -1, 0, 0
"""High bits of the time, their wraps, low bits, y, base x, its polarity; negative ones are not known."""


def matches_evt(path: Path, head: bytes) -> bool:
    """Whether the header names an EVT format."""
    return head.startswith(b"% ") and (b"% evt " in head or b"% format EVT" in head)


def matches_dat(path: Path, head: bytes) -> bool:
    """Whether there is a header of % lines without a mention of EVT."""
    return head.startswith(b"% ") and not matches_evt(path, head)


def open_evt(path: Path, choices: Choices) -> Source:
    """Open the events of EVT2, 2.1 or 3; the sensor's size comes from the header, or from the sensor's name there."""
    header, _, _ = header_lines(path, PREFIX, LAST_LINE, MAX_HEADER_BYTES)
    stated = re.search(rb"% (?:evt |format EVT)(\d)\.?(\d)?", header)
    version = b".".join(filter(None, stated.groups())).decode().removesuffix(".0") if stated else "none"
    if version not in EVT:
        raise RecordingError(f"{path.name}: expected a header of % lines that states EVT 2, 2.1 or 3, got {version}")
    height, width = _evt_size(header)
    legacy = version == "2.1" and _is_legacy(header)

    def blocks(counts: Counts) -> Iterator[Block]:
        state = np.array(EVT_START)
        for words in word_blocks(path, len(header), EVT[version][0], EVT_BLOCK_WORDS, counts):
            if legacy:  # the two halves are exchanged
                words = words << np.uint64(32) | words >> np.uint64(32)
            yield evt_block(version, words, state, counts)

    return Source(height, width, blocks)


def evt_block(version: str, words: np.ndarray, state: Int64[np.ndarray, " 6"], counts: Counts) -> Block:
    """Decode the next words of a format, a key of `EVT`; `state`, first `EVT_START`, is updated.

    Events before the first time or row are counted as `orphans`.
    """
    _, per_word, decode_words = EVT[version]
    columns = [np.empty(per_word * len(words), t) for t in (np.int64, np.int16, np.int16, np.int8)]
    events, orphans = decode_words(words, state, *columns)
    counts["orphans"] += int(orphans)
    return Block(*(column[:events] for column in columns))


def open_dat(path: Path, choices: Choices) -> Source:
    """Open change detection events of version 1 or 2; times that wrap after 71 minutes are unwrapped."""
    header, after, _ = header_lines(path, PREFIX, LAST_LINE, MAX_HEADER_BYTES)
    if len(after) < 2 or after == PREFIX:
        raise RecordingError(f"{path.name}: the file ends within its header of % lines")
    kind, size = after
    if kind not in CHANGE_DETECTION or size != DAT_EVENT.itemsize:
        raise RecordingError(
            f"{path.name}: expected events of type 0 or 12 and 8 bytes, as DAT has for changes, got type {kind} and "
            f"{size} bytes"
        )
    stated = {name: int(value) for name, value in re.findall(rb"% (Version|Height|Width) (\d{1,9})\s", header)}
    version = stated.get(b"Version", 1)
    if version not in (1, 2):
        raise RecordingError(f"{path.name}: expected DAT of version 1 or 2, got {version}")

    def blocks(counts: Counts) -> Iterator[Block]:
        for t, events in unwrapped(word_blocks(path, len(header) + 2, DAT_EVENT, BLOCK_EVENTS, counts)):
            address = events["address"]
            if version == 1:
                yield Block(t, address & 0x1FF, address >> 9 & 0xFF, address >> 17 & 1)
            else:
                yield Block(t, address & 0x3FFF, address >> 14 & 0x3FFF, address >> 28)

    return Source(stated.get(b"Height"), stated.get(b"Width"), blocks)


def _evt_size(header: bytes) -> tuple[int | None, int | None]:
    if geometry := re.search(rb"% geometry (\d{1,5})x(\d{1,5})", header):
        return int(geometry[2]), int(geometry[1])
    height, width = (re.search(name + rb"=(\d{1,5})", header) for name in (b"height", b"width"))
    if height and width:
        return int(height[1]), int(width[1])
    for size, (names, generation, systems) in SENSORS.items():
        named = rb"(?:plugin|sensor)_name [^\n]*(?:" + names + rb")|sensor_generation " + generation
        if re.search(rb"(?i)% (?:" + named + rb")", header) or _system_id(header) in systems:
            return size
    return None, None


def _is_legacy(header: bytes) -> bool:
    if stated := re.search(rb"endianness[= ](\w+)", header):
        return stated[1] == b"legacy"
    others = re.search(rb"integrator_name (?!Prophesee)", header)
    return others is None and 0 < _system_id(header) < FIRST_LITTLE_ENDIAN


def _system_id(header: bytes) -> int:
    """The camera's system ID; 0 without one."""
    stated = re.search(rb"% system_ID (\d{1,9})\s", header)
    return int(stated[1]) if stated else 0


def _decode_evt2(words: np.ndarray, *state_and_columns: np.ndarray) -> tuple[int, int]:
    """Decode words of 32 bits: each is the upper half of an EVT2.1 word, for one pixel."""
    return _decode_evt21(words.astype(np.uint64) << 32 | 1, *state_and_columns)


@compiled
def _decode_evt21(words, state, t, x, y, p):
    """Decode words of 64 bits by their upper 4 bits: 0 OFF, 1 ON, with a mask of 32 pixels from x on; 8 upper time."""
    high, turns = state[0], state[1]
    n, orphans = 0, 0
    for i in range(len(words)):
        upper, valid = np.int64(words[i] >> np.uint64(32)), np.int64(words[i] & np.uint64(0xFFFFFFFF))
        kind = upper >> 28
        if kind == 8:
            before, high = high, upper & 0xFFFFFFF
            turns += before - high > 2**27
        elif kind <= 1:
            if high < 0:
                orphans += 1
                continue
            now, column = ((turns << 28 | high) << 6) | (upper >> 22 & 0x3F), upper >> 11 & 0x7FF
            while valid:
                if valid & 1:
                    t[n], x[n], y[n], p[n] = now, column, upper & 0x7FF, kind
                    n += 1
                valid, column = valid >> 1, column + 1
    state[0], state[1] = high, turns
    return n, orphans


@compiled
def _decode_vectors(kinds, words, state, t, x, y, p):
    """Decode words of 16 bits by the kinds of their upper 4 bits; masks are of neighbours in x."""
    high, turns, low, row, base, polarity = state
    n, orphans = 0, 0
    for i in range(len(words)):
        word = np.int64(words[i])
        kind, value = kinds[np.uint64(word >> 12)], word & 0xFFF  # unsigned: no check for a place from the end
        if kind == LOW:
            low = value
        elif kind in (HIGH, HIGH_AND_LOW):
            before, high = high, value
            turns += before - high > 2**11
            low = 0 if kind == HIGH_AND_LOW and before != high else low
        elif kind == ROW:
            row = value & 0x7FF
        elif kind == BASE:
            base, polarity = value & 0x7FF, value >> 11
        elif kind != NOTHING:
            if high < 0 or row < 0:
                orphans += 1
                continue
            now = (turns << 12 | high) << 12 | low
            if kind == PIXEL:
                t[n], x[n], y[n], p[n] = now, value & 0x7FF, row, value >> 11
                n += 1
                continue
            for k in range(kind):
                if value >> k & 1:
                    t[n], x[n], y[n], p[n] = now, base + k, row, polarity
                    n += 1
            base = min(base + kind, 2048)  # outside every sensor; larger values would not fit into int16
    state[:] = high, turns, low, row, base, polarity
    return n, orphans


EVT = {
    "2": ("<u4", 1, _decode_evt2),
    "2.1": ("<u8", 32, _decode_evt21),
    "3": ("<u2", 12, partial(_decode_vectors, EVT3_KINDS)),
    "libcaer_cmp": ("<u2", 8, partial(_decode_vectors, LIBCAER_KINDS)),
}
"""Word, most events in a word, and decoder of each version of EVT, and of libcaer's packets of the same kind."""
