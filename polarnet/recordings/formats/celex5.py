"""Files of a CeleX-5: raw ones (BIN, little endian), and event lists from the vendor's converter (CSV).

A BIN file has packages of events or of a full picture, as the sensor sends them. A header gives the data type (bit 0
loop mode, bit 1 IMU), the modes of the sensor, the event format, the time of day and the number of packages. Each
package is a length and that many bytes. With an IMU, the computer's time in milliseconds and the IMU's samples follow.
The last byte of a package is 0 for a full picture.

The sensor sends 14-bit words, four in 7 bytes: the high 8 bits of each, then the low 6 of all. An item is two words,
and its two lowest bits give its kind. Time stamps of 16 bits wrap around.

A line of CSV is row, column, intensity (0 to 4095), polarity (-1, 0 or 1), t in Event Intensity mode.
"""

import operator
import struct
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64, UInt8, UInt16

from polarnet.recordings.content import start_of, unpacked
from polarnet.recordings.formats.lines import HEAD_BYTES, number_blocks, numbers_of
from polarnet.recordings.source import Block, Choices, Counts, RecordingError, Source
from polarnet.runtime.compilation import compiled

HEIGHT, WIDTH = 800, 1280
WHITE = 4095  # maximum of the 12-bit converter

CLOCK_MHZ = 100  # the vendor's default
TICK_CYCLES = 1024  # clock cycles per step of the time stamp

HEADER = struct.Struct("<8B I")
LENGTH = struct.Struct("<I")
STAMP = struct.Struct("<q I")  # the computer's time in milliseconds, and the number of IMU samples that follow
IMU_SAMPLE_BYTES = 32
LOOP, IMU = 1, 2  # bits of the data type

MODES = ("Event Off-Pixel Timestamp", "Event In-Pixel Timestamp", "Event Intensity", "Full Picture",
         "Optical Flow", "Optical Flow FPN", "Multi-Read Optical Flow")  # fmt: skip
INTENSITY, FULL_PICTURE, NO_MODE = 2, 3, b"\xff"  # of `MODES`
MAX_HEADER = bytes([LOOP | IMU, *[len(MODES)] * 3, 2, 23, 59, 59])  # largest values of a header's first 8 bytes

PICTURE_BYTES = HEIGHT * WIDTH * 3 // 2 + 1
MAX_PACKAGE = 2_048_000  # bytes; the limit of the vendor's library

ROW, COLUMN = 2, 1  # kinds of items
CSV_COLUMNS = 5


Header = namedtuple("Header", "data_type loop_a loop_b loop_c event_format hour minute second packages")
"""The first 12 bytes of a file; loop_a is the sensor's mode outside loop mode."""


class Picture(NamedTuple):
    """A full picture."""

    t_us: int | None
    """The computer's time on arrival, the middle of its millisecond; None in files without it."""
    intensity: UInt16[np.ndarray, "h w"]
    """800 x 1280 pixels from a BIN file; 0 to 4095; brighter is larger."""


def matches_bin(path: Path, head: bytes) -> bool:
    """Whether the header and the first length are plausible for a BIN file."""
    length = head[HEADER.size : HEADER.size + LENGTH.size]
    return _header(head) is not None and (len(length) < LENGTH.size or 0 < LENGTH.unpack(length)[0] <= MAX_PACKAGE)


def open_bin(path: Path, choices: Choices) -> Source:
    """Open the events of a BIN file of event format 1 in Event Intensity mode; RecordingError for other modes.

    A pixel's polarity is the sign of its intensity change. Its first event is compared with 0 and therefore brighter.
    Time 0 is the first time stamp. Full pictures between the events are left out; `celex5_pictures` reads them.
    """
    header = _opened(path)
    looped = header.data_type & LOOP
    if header.event_format != 1 or looped or header.loop_a < INTENSITY:
        mode = dict(enumerate(MODES)).get(header.loop_a, "unknown")
        raise RecordingError(
            f"{path.name}: expected Event Intensity mode, event format 1, got {'a loop from ' if looped else ''}mode "
            f"{mode}, event format {header.event_format}; other modes and format 2 have no polarity, format 0 has "
            f"wrong intensities, and in a loop times stand still during pictures: record again"
        )

    def blocks(counts: Counts) -> Iterator[Block]:
        state = np.array([-1, -1, 0])  # row, last time stamp, ticks since the first
        last_adc = np.zeros((HEIGHT, WIDTH), np.uint16)
        for _, package in _packages(path, counts):
            if package[-1] == 0:
                state[0] = -1  # the events after a picture begin with their row
            else:
                counts["unreadable_packages"] += len(package) % 7 != 1
                size = 2 * (len(package) // 7)
                columns = tuple(np.empty(size, dtype) for dtype in (np.int64, np.int16, np.int16, np.int8))
                events, orphans, unchanged = _decode(package[:-1], state, last_adc, columns)
                counts.update({"orphans": orphans, "no_change": unchanged})
                t, x, y, p = (column[:events] for column in columns)
                yield Block(microseconds(t), x, y, p)

    return Source(HEIGHT, WIDTH, blocks)


def microseconds(ticks: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Convert the sensor's time stamps to microseconds, rounded down as in the vendor's library."""
    return ticks * TICK_CYCLES // CLOCK_MHZ


def celex5_pictures(path: Path) -> Iterator[Picture]:
    """The full pictures of a BIN file, in order; RecordingError for other or damaged files."""
    counts = Counts()
    for t_ms, package in _packages(path, counts):
        if package[-1] == 0:
            if len(package) != PICTURE_BYTES:
                raise RecordingError(
                    f"{path.name}: expected {PICTURE_BYTES} bytes of a full picture, got {len(package)}; "
                    f"the file is damaged"
                )
            yield Picture(None if t_ms is None else 1000 * t_ms + 500, _unpacked(package[:-1]))


def matches_csv(path: Path, head: bytes) -> bool:
    """Whether there are five columns with commas, the fourth mostly a polarity."""
    lines = [line.words for line in numbers_of(head)]
    if not lines or b"," not in head or len(lines[0]) != CSV_COLUMNS:
        return False
    return 2 * sum(len(words) == CSV_COLUMNS and words[3] in ("-1", "0", "1") for words in lines) > len(lines)


def open_csv(path: Path, choices: Choices) -> Source:
    """Open a CSV file of Event Intensity mode (times in us); RecordingError for other modes, without polarity."""
    lines = numbers_of(start_of(path, HEAD_BYTES))
    if lines and len(lines[0].words) != CSV_COLUMNS:
        raise RecordingError(
            f"{path.name}: expected the 5 columns row,col,adc,polarity,t of a CeleX-5 in Event Intensity mode, got "
            f"{len(lines[0].words)}; its other modes, of 3 or 4 columns, have no polarity"
        )

    def blocks(counts: Counts) -> Iterator[Block]:
        for rows in number_blocks(path, (0,) * CSV_COLUMNS, 0, counts):
            changed = rows[:, 3] != 0
            row, column, p, t = (rows[:, k][changed] for k in (0, 1, 3, 4))
            counts["no_change"] += len(rows) - len(t)
            yield Block(t, column, row, p)

    return Source(HEIGHT, WIDTH, blocks)


def _unpacked(data: np.ndarray) -> np.ndarray:
    """Unpack two 12-bit pixels from 3 bytes: their high 8 bits, then the low 4 of the first, then those of the second.

    The sensor sends larger values for darker pixels, so they are inverted. It sends its mode in place of the high bits
    of pixel (0, 0), which gets the value of pixel (0, 1).
    """
    first, second, low = data.reshape(-1, 3).T.astype(np.uint16)
    pixels = np.stack([first << 4 | low & 15, second << 4 | low >> 4], axis=1)
    picture = np.uint16(WHITE) - pixels.reshape(HEIGHT, WIDTH)
    picture[0, 0] = picture[0, 1]
    return picture


def _header(head: bytes) -> Header | None:
    """The header of a BIN file; None if the bytes are too few or not plausible."""
    modes = head[1:4].replace(NO_MODE, b"\0")
    if len(head) < HEADER.size or any(map(operator.gt, head[:1] + modes + head[4:8], MAX_HEADER)):
        return None
    return Header(*HEADER.unpack_from(head))


def _opened(path: Path) -> Header:
    if header := _header(start_of(path, HEADER.size)):
        return header
    raise RecordingError(f"{path.name}: expected the {HEADER.size} bytes of a BIN header of a CeleX-5 at its start")


def _packages(path: Path, counts: Counts) -> Iterator[tuple[int | None, UInt8[np.ndarray, " bytes"]]]:
    """The computer's time in milliseconds, and the bytes, of each package."""
    header = _opened(path)
    with unpacked(path) as file:
        file.seek(HEADER.size)
        number = 0
        while start := file.read(LENGTH.size):
            length = LENGTH.unpack(start)[0] if len(start) == LENGTH.size else 1
            if not 0 < length <= MAX_PACKAGE:
                raise RecordingError(
                    f"{path.name}: package {number} before byte {file.tell()} states a length of {length} bytes, "
                    f"expected up to {MAX_PACKAGE}; the file is damaged there and what follows cannot be found"
                )
            package = file.read(length)
            if len(start) < LENGTH.size or len(package) < length:
                counts["cut_tail"] += 1
                return
            t_ms = None
            if header.data_type & IMU and len(stamp := file.read(STAMP.size)) == STAMP.size:
                t_ms, samples = STAMP.unpack(stamp)
                if samples * IMU_SAMPLE_BYTES > MAX_PACKAGE or not abs(t_ms) < 2**43:
                    raise RecordingError(
                        f"{path.name}: a package has {samples} IMU samples at {t_ms} ms; the file is damaged"
                    )
                file.seek(samples * IMU_SAMPLE_BYTES, 1)
            yield t_ms, np.frombuffer(package, np.uint8)
            number += 1


@compiled
def _decode(data, state, last_adc, columns):
    """Decode items of 28 bits: row and time stamp, or intensity and column."""
    row, stamp, now = state
    t, x, y, p = columns
    n, orphans, unchanged = 0, 0, 0
    height, width = last_adc.shape
    for i in range(len(data) // 7):
        a, b, c, d = data[7 * i], data[7 * i + 1], data[7 * i + 2], data[7 * i + 3]
        low = np.int64(data[7 * i + 4]) | np.int64(data[7 * i + 5]) << 8 | np.int64(data[7 * i + 6]) << 16
        first = np.int64(b) << 20 | (low >> 6 & 63) << 14 | np.int64(a) << 6 | low & 63
        second = np.int64(d) << 20 | low >> 18 << 14 | np.int64(c) << 6 | low >> 12 & 63
        for item in (first, second):
            kind = item & 3
            if kind == ROW:
                row = item >> 18
                tick = item >> 2 & 0xFFFF
                if stamp >= 0:
                    now += (tick - stamp) & 0xFFFF
                stamp = tick
            elif kind == COLUMN:
                if row < 0:
                    orphans += 1
                    continue
                adc = 4095 - (item >> 16)
                column = item >> 5 & 0x7FF
                sign = 1
                if row < height and column < width:
                    before = np.int64(last_adc[row, column])
                    last_adc[row, column] = adc
                    sign = 1 if adc > before else -1 if adc < before else 0
                if sign == 0:
                    unchanged += 1
                else:
                    t[n], x[n], y[n], p[n] = now, column, row, sign
                    n += 1
    state[:] = row, stamp, now
    return n, orphans, unchanged
