"""AEDAT-2 of jAER and AEDAT 3.1 of cAER and DV; each begins with a header of # lines.

AEDAT-2, from a DAVIS (such as the PDAVIS), has 8 bytes per event, big endian. The first four are an address: y from the
bottom in bits 22 to 30, the column in bits 12 to 21, the polarity in bit 11. Entries with bit 31 (a frame's sample) or
bit 10 (from the IMU or outside) set are not pixel events. The other four bytes are microseconds.

The column of an event counts from the right (width - 1 - x), that of a frame's sample from the left, as in jAER's
DavisBaseCamera, tonic and v2e: with an even width, the other way round would exchange the columns of a mosaic.

A frame has two samples of each pixel, of 10 bits: one after its reset (bits 10 and 11 are 0) and one after the exposure
(bit 10 is 1, bit 11 is 0). Light is their difference.

AEDAT 3.1 has packets, little endian: a header of 28 bytes and events. An event of a pixel has 4 bytes of data (valid in
bit 0, polarity in bit 1, y from the top in bits 2 to 16, x from the left in bits 17 to 31) and 4 bytes of microseconds.
The higher bits of the time are in the packet's header.
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polarnet.recordings.content import header_lines, unpacked, unwrapped, word_blocks
from polarnet.recordings.source import BLOCK_EVENTS, Block, CameraFrames, Choices, Counts, RecordingError, Source

MAGIC_2, MAGIC_3 = b"#!AER-DAT2", b"#!AER-DAT3"
LAST_LINE_2 = b"#End Of ASCII Header"  # only in newer files; an event can begin with # too
LAST_LINE_3 = b"#!END-HEADER"
MAX_HEADER_BYTES = 2**20  # jAER writes its settings into the header
SENSORS = {b"128": (128, 128), b"240": (180, 240), b"346": (260, 346), b"208": (192, 208), b"640": (480, 640)}
"""Height and width by the number in the camera's name."""
DVS128 = b"128"  # its addresses in AEDAT-2 have another layout

ENTRY = np.dtype([("address", ">u4"), ("t", ">u4")])
NO_EVENT = 1 << 31 | 1 << 10
SAMPLE, RESET_READ, SIGNAL_READ = 1 << 31, 0, 1  # the bit of a frame's sample, and the bits 10 and 11 of its two reads

PACKET = struct.Struct("<2h 6i")  # kind, source, bytes an event, offset of its time, overflows, capacity, number, valid
MAX_PACKET_BYTES = 2**30
PIXEL_EVENTS = 1  # kind of packets
EVENT = np.dtype([("data", "<u4"), ("t", "<i4")])


def open_aedat2(path: Path, choices: Choices) -> Source:
    """Open the events of a DAVIS; times that wrap after 71 minutes are unwrapped."""
    start, height, width = _described(path, choices)

    def blocks(counts: Counts) -> Iterator[Block]:
        entries = word_blocks(path, start, ENTRY, BLOCK_EVENTS, counts)
        for t, events in unwrapped(block[block["address"] & NO_EVENT == 0] for block in entries):
            address = events["address"].astype(np.int64)
            x, y = width - 1 - (address >> 12 & 0x3FF), height - 1 - (address >> 22 & 0x1FF)
            yield Block(t, x, y, address >> 11 & 1)

    return Source(height, width, blocks)


def aedat2_frames(path: Path) -> CameraFrames:
    """Frames of a DAVIS: 10-bit light of every pixel. Times (us) are the middle of the exposure, averaged over pixels.

    A frame that lacks samples, such as the last one of a file, is left out. RecordingError if none is complete.
    """
    start, height, width = _described(path, Choices())
    times, frames = [], []
    reset, reset_us = np.full(height * width, -1), np.zeros(height * width, np.int64)
    light, middle_us = np.full(height * width, -1), np.zeros(height * width)
    for t, block in unwrapped(word_blocks(path, start, ENTRY, BLOCK_EVENTS, Counts())):
        address = block["address"].astype(np.int64)
        pixel = (height - 1 - (address >> 22 & 0x1FF)) * width + (address >> 12 & 0x3FF)
        kind = address >> 10 & 3
        samples = np.flatnonzero((address & SAMPLE != 0) & (kind <= SIGNAL_READ) & (pixel >= 0) & (pixel < len(light)))
        for run in np.split(samples, np.flatnonzero(np.diff(kind[samples])) + 1):
            where, value, now = pixel[run], address[run] & 0x3FF, t[run]
            if (kind[run] == RESET_READ).all():
                reset[where], reset_us[where], light[where] = value, now, -1
                continue
            light[where] = np.where(reset[where] < 0, -1, np.maximum(reset[where] - value, 0))
            middle_us[where] = (reset_us[where] + now) / 2
            if (light >= 0).all():
                times.append(round(middle_us.mean()))
                frames.append(light.astype(np.uint16))
                light[:] = -1
    if not frames:
        raise RecordingError(
            f"{path.name}: expected frames of the DAVIS as true polarization, got no whole one; record frames too"
        )
    return CameraFrames(np.array(times), np.stack(frames).reshape(-1, height, width))


def _described(path: Path, choices: Choices) -> tuple[int, int, int]:
    """Length of the header in bytes, and height and width of the sensor."""
    header, after, ended = header_lines(path, b"#", LAST_LINE_2, MAX_HEADER_BYTES)
    if not header.startswith(MAGIC_2) or (not ended and after.startswith(b"#")):
        raise RecordingError(f"{path.name}: expected AEDAT-2's header of # lines, and events after it")
    chip = re.search(rb"# AEChip: [\w.]*?(346|240|128)", header)
    if chip and chip[1] == DVS128:
        raise RecordingError(f"{path.name}: expected the recording of a DAVIS, got one of a DVS128")
    return len(header), *choices.sensor_of(path.name, *(SENSORS[chip[1]] if chip else (None, None)))


def open_aedat3(path: Path, choices: Choices) -> Source:
    """Open the events of the only source, or of the source of the number `part`; a cut file is read up to its end."""
    header, _, ended = header_lines(path, b"#", LAST_LINE_3, MAX_HEADER_BYTES)
    if not ended:
        raise RecordingError(f"{path.name}: expected AEDAT 3.1's header of # lines up to {LAST_LINE_3.decode()}")
    if (form := re.search(rb"#Format: *([\w, ]+)", header)) and form[1] != b"RAW":
        raise RecordingError(
            f"{path.name}: expected AEDAT 3.1 of format RAW, got {form[1].decode()}; convert it with DV"
        )
    names = {number.decode(): name for number, name in re.findall(rb"#Source (\d+): *(\S+)", header)}
    source = choices.part_of(path.name, list(names), "source of events")
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
