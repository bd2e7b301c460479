"""AEDAT-2 files of jAER from a DAVIS (such as the PDAVIS): a header of # lines, then 8 bytes per event, big endian.

The first four bytes are an address: y from the bottom in bits 22 to 30, x in bits 12 to 21, the polarity in bit 11.
Entries with bit 31 (a picture's sample) or bit 10 (from the IMU or outside) set are not pixel events. The other four
bytes are microseconds.
"""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polarnet.recordings.source import (
    BLOCK_EVENTS,
    Block,
    Choices,
    RecordingError,
    Source,
    header_lines,
    sensor_size,
    unwrapped,
    word_blocks,
)

MAGIC = b"#!AER-DAT2"
LAST_LINE = b"#End Of ASCII Header"  # only in newer files; an event can begin with # too
MAX_HEADER_BYTES = 2**20  # jAER writes its settings into the header
ENTRY = np.dtype([("address", ">u4"), ("t", ">u4")])
NO_EVENT = 1 << 31 | 1 << 10
SENSORS = {b"346": (260, 346), b"240": (180, 240), b"128": None}
"""Height and width by the number in the camera's class name in the header; the DVS128 uses another address layout."""


def matches(path: Path, head: bytes) -> bool:
    """Whether the file starts with the format's signature."""
    return head.startswith(MAGIC)


def open_aedat2(path: Path, choices: Choices) -> Source:
    """Open the events of a DAVIS; times that wrap after 71 minutes are unwrapped."""
    header, after, ended = header_lines(path, b"#", LAST_LINE, MAX_HEADER_BYTES)
    if not header.startswith(MAGIC) or (not ended and after.startswith(b"#")):
        raise RecordingError(f"{path.name}: expected AEDAT-2's header of # lines, and events after it")
    chip = re.search(rb"# AEChip: [\w.]*?(346|240|128)", header)
    size = SENSORS[chip[1]] if chip else (None, None)
    if size is None:
        raise RecordingError(f"{path.name}: expected the recording of a DAVIS, got one of a DVS128")
    height, width = sensor_size(path, choices, *size)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        entries = word_blocks(path, len(header), ENTRY, BLOCK_EVENTS, counts)
        for t, events in unwrapped(block[block["address"] & NO_EVENT == 0] for block in entries):
            address = events["address"].astype(np.int64)
            yield Block(t, address >> 12 & 0x3FF, height - 1 - (address >> 22 & 0x1FF), address >> 11 & 1)

    return Source(height, width, blocks)
