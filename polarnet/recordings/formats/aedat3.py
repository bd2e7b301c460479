"""AEDAT 3.1 files of cAER and DV: a header of # lines, then packets, little endian.

A packet is a header of 28 bytes and its events. An event of a pixel has 4 bytes of data (valid in bit 0, polarity in
bit 1, y from the top in bits 2 to 16, x from the left in bits 17 to 31) and 4 bytes of microseconds. The higher bits of
the time are in the packet's header.
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polarnet.recordings.source import (
    Block,
    Choices,
    Counts,
    RecordingError,
    Source,
    chosen_part,
    header_lines,
    unpacked,
)

MAGIC = b"#!AER-DAT3"
LAST_LINE = b"#!END-HEADER"
MAX_HEADER_BYTES = 2**16
PACKET = struct.Struct("<2h 6i")  # kind, source, bytes an event, offset of its time, overflows, capacity, number, valid
MAX_PACKET_BYTES = 2**30
PIXEL_EVENTS = 1  # kind of packets
EVENT = np.dtype([("data", "<u4"), ("t", "<i4")])
SENSORS = {b"128": (128, 128), b"240": (180, 240), b"346": (260, 346), b"208": (192, 208), b"640": (480, 640)}
"""Height and width by the number in the camera's name."""


def open_aedat3(path: Path, choices: Choices) -> Source:
    """Open the events of the only source, or of the source of the number `part`; a cut file is read up to its end."""
    header, _, ended = header_lines(path, b"#", LAST_LINE, MAX_HEADER_BYTES)
    if not ended:
        raise RecordingError(f"{path.name}: expected AEDAT 3.1's header of # lines up to {LAST_LINE.decode()}")
    if (form := re.search(rb"#Format: *([\w, ]+)", header)) and form[1] != b"RAW":
        raise RecordingError(
            f"{path.name}: expected AEDAT 3.1 of format RAW, got {form[1].decode()}; convert it with DV"
        )
    names = {number.decode(): name for number, name in re.findall(rb"#Source (\d+): *(\S+)", header)}
    source = chosen_part(path, choices.part, list(names), "source of events")
    camera = re.search(rb"\d{3}", names[source])
    height, width = SENSORS.get(camera[0], (None, None)) if camera else (None, None)

    def blocks(counts: Counts) -> Iterator[Block]:
        for overflows, events in _packets(path, len(header), int(source), counts):
            events = events[events["data"] & 1 == 1]
            data, t = events["data"], events["t"] + (np.int64(overflows) << 31)
            yield Block(t, data >> 17, data >> 2 & 0x7FFF, data >> 1 & 1)

    return Source(height, width, blocks)


def _packets(path: Path, start: int, wanted: int, counts: Counts) -> Iterator[tuple[int, np.ndarray]]:
    """Overflows of the time and events of each packet of a source; a packet that is cut is counted as `cut_tail`."""
    with unpacked(path) as file:
        file.seek(start)
        while header := file.read(PACKET.size):
            if len(header) < PACKET.size:
                counts["cut_tail"] += 1
                return
            kind, source, size, _, overflows, _, number, _ = PACKET.unpack(header)
            if not (0 <= number * size <= MAX_PACKET_BYTES and (kind != PIXEL_EVENTS or size == EVENT.itemsize)):
                raise RecordingError(
                    f"{path.name}: the packet before byte {file.tell()} states {number} events of {size} bytes; the "
                    f"file is damaged there and what follows cannot be found"
                )
            content = file.read(number * size)
            counts["cut_tail"] += len(content) < number * size
            if kind == PIXEL_EVENTS and source == wanted:
                yield overflows, np.frombuffer(content, EVENT, len(content) // EVENT.itemsize)
