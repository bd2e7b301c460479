"""Prophesee's DAT files: a header of lines that start with %, then 8 bytes per event, little endian."""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from polarnet.recordings.source import BLOCK_EVENTS, Block, Choices, RecordingError, Source, running_on, sensor_size

MAX_HEADER_BYTES = 2**16
EVENT_BYTES = 8
CHANGE_DETECTION = (0, 12)  # event types: 2D of the first sensors, CD of the later ones


class Header(NamedTuple):
    """Content of the header."""

    version: int
    height: int | None
    width: int | None
    start: int
    """Byte offset of the events."""


def matches(path: Path, head: bytes) -> bool:
    """Whether there is a header of % lines without a mention of EVT."""
    return head.startswith(b"% ") and b"% evt " not in head and b"% format EVT" not in head


def open_dat(path: Path, choices: Choices) -> Source:
    """Open change detection events of version 1 or 2; in version 2, times that wrap after 71 minutes are unwrapped."""
    header = _header(path)
    height, width = sensor_size(path, choices, header.height, header.width)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        turns, before = 0, 0
        with path.open("rb") as file:
            file.seek(header.start)
            while data := file.read(BLOCK_EVENTS * EVENT_BYTES):
                counts["cut_tail"] += len(data) % EVENT_BYTES != 0
                words = np.frombuffer(data[: len(data) // EVENT_BYTES * EVENT_BYTES], "<u4").reshape(-1, 2)
                if not len(words):
                    continue
                t, turns, before = running_on(words[:, 0], turns, before)
                address = words[:, 1]
                if header.version == 1:
                    yield Block(t, address & 0x1FF, address >> 9 & 0xFF, address >> 17 & 1)
                else:
                    yield Block(t, address & 0x3FFF, address >> 14 & 0x3FFF, address >> 28)

    return Source(height, width, blocks)


def _header(path: Path) -> Header:
    with path.open("rb") as file:
        data = file.read(MAX_HEADER_BYTES)
    start = 0
    while data[start : start + 2] == b"% " and (end := data.find(b"\n", start)) >= 0:
        start = end + 1
    if data[start : start + 2] == b"% " or len(data) < start + 2:
        raise RecordingError(f"{path.name}: the file ends within its header of % lines")
    kind, size = data[start], data[start + 1]
    if kind not in CHANGE_DETECTION or size != EVENT_BYTES:
        raise RecordingError(
            f"{path.name}: expected events of type 0 or 12 and 8 bytes, as DAT has for changes, got type {kind} and "
            f"{size} bytes"
        )
    found = {name: int(value) for name, value in re.findall(rb"% (Version|Height|Width) (\d{1,9})\s", data[:start])}
    version = found.get(b"Version", 1)
    if version not in (1, 2):
        raise RecordingError(f"{path.name}: expected DAT of version 1 or 2, got {version}")
    return Header(version, found.get(b"Height"), found.get(b"Width"), start + 2)
