"""Write BIN files of a CeleX-5, for simulated cameras and for tests of the reader in `celex5_bin`."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int64, UInt8, UInt16

from polarnet.events.stream import Events, validate
from polarnet.recordings.formats.celex5 import CLOCK_MHZ, HEIGHT, WHITE, WIDTH, microseconds, ticks
from polarnet.recordings.formats.celex5_bin import (
    COLUMN,
    FULL_PICTURE,
    HEADER,
    IMU,
    INTENSITY,
    LENGTH,
    OFF_PIXEL,
    PICTURE_BYTES,
    ROW,
    STAMP,
    STAMP_BITS,
    TIME,
)

PACKAGE_GROUPS = 51_000  # 7 bytes each; the sensor sends only packages of this length
NO_MODE = 255


def write_celex5_bin(path: Path, events: Events, event_format: int = 1, clock_mhz: float | int = CLOCK_MHZ) -> Events:
    """Write events as the sensor sends them, and return the events that a reader gets from the file.

    Each time becomes the sensor's first time stamp at or after it (every 10.24 us at 100 MHz), from 0 on. In format 1
    polarity is a change of intensity, which starts from 0, so a pixel that first becomes darker gets a brighter event
    at the start. Format 2 has no polarity; the returned polarity is +1 everywhere, as with `assume_polarity=1`.
    ValueError for events that are out of order, before 0, off a sensor of 800 x 1280, or more than 4095 of one polarity
    in a row in a pixel.
    """
    if event_format not in STAMP_BITS:
        raise ValueError(f"expected event format 1 or 2, got {event_format}")
    if events.height > HEIGHT or events.width > WIDTH:
        raise ValueError(f"expected events of a sensor of {HEIGHT}x{WIDTH}, got {events.height}x{events.width}")
    validate(events)
    if len(events) and events.t[0] < 0:
        raise ValueError(f"expected times from 0 on, got {int(events.t[0])} us")
    stamp = ticks(events.t.numpy(), clock_mhz)
    row, column = events.y.numpy().astype(np.int64), events.x.numpy().astype(np.int64)
    p = events.p.numpy()
    if event_format == 1:
        first_is_darker = _first_is_darker(row * WIDTH + column, p)
        stamp = np.concatenate([np.zeros(first_is_darker.sum(), np.int64), stamp])
        row, column = (np.concatenate([values[first_is_darker], values]) for values in (row, column))
        p = np.concatenate([np.ones(first_is_darker.sum(), np.int8), p])
        items = _items_1(stamp, row, column, _intensities(row * WIDTH + column, p))
        words = np.stack([items & 0x3FFF, items >> 14], axis=1).reshape(-1)
    else:
        p = np.ones_like(p)
        words = _items_2(stamp, row, column)
    _write_packages(path, _packed(words, event_format), event_format)
    return Events(
        torch.from_numpy(microseconds(stamp, clock_mhz)),
        torch.from_numpy(column.astype(np.int16)),
        torch.from_numpy(row.astype(np.int16)),
        torch.from_numpy(p.copy()),
        HEIGHT,
        WIDTH,
    )


def write_celex5_pictures(
    path: Path, pictures: Iterable[UInt16[np.ndarray, "800 1280"]], t_us: Iterable[int] | None = None
) -> None:
    """Write full pictures of 0 to 4095 (brighter is larger), with the computer's time to the millisecond where given.

    Pixel (0, 0) is lost, since the sensor stores its mode there.
    """
    stamps = None if t_us is None else iter(t_us)
    packages = 0
    with path.open("wb") as file:
        file.write(_header(FULL_PICTURE, 1, IMU if stamps else 0, 0))
        for picture in pictures:
            if picture.shape != (HEIGHT, WIDTH) or picture.max() > WHITE:
                raise ValueError(
                    f"expected pictures of {HEIGHT}x{WIDTH} up to {WHITE}, got {picture.shape} up to {picture.max()}"
                )
            file.write(LENGTH.pack(PICTURE_BYTES))
            file.write(_packed_picture(picture).tobytes() + b"\0")
            if stamps:
                file.write(STAMP.pack(next(stamps) // 1000, 0))
            packages += 1
        file.seek(0)
        file.write(_header(FULL_PICTURE, 1, IMU if stamps else 0, packages))


def _header(mode: int, event_format: int, data_type: int, packages: int) -> bytes:
    return HEADER.pack(data_type, mode, NO_MODE, NO_MODE, event_format, 0, 0, 0, packages)


def _packed_picture(picture: np.ndarray) -> np.ndarray:
    dark = np.uint16(WHITE) - picture.reshape(-1, 2)
    dark[0, 0] = FULL_PICTURE << 9
    low = dark[:, 0] & 15 | (dark[:, 1] & 15) << 4
    return np.stack([dark[:, 0] >> 4, dark[:, 1] >> 4, low], axis=1).astype(np.uint8)


def _first_is_darker(pixel: Int64[np.ndarray, " n"], p: np.ndarray) -> np.ndarray:
    first = np.zeros(len(p), np.bool_)
    first[np.unique(pixel, return_index=True)[1]] = True
    return first & (p < 0)


def _intensities(pixel: Int64[np.ndarray, " n"], p: np.ndarray) -> Int64[np.ndarray, " n"]:
    """An intensity from 1 to 4095 for each event, above or below that of the pixel's previous event."""
    order = np.argsort(pixel, kind="stable")
    level = np.cumsum(p[order], dtype=np.int64)
    starts = np.flatnonzero(np.diff(pixel[order], prepend=-1))
    length = np.diff(np.append(starts, len(p)))
    lowest = np.minimum.reduceat(level, starts) if len(starts) else level
    level += np.repeat(1 - lowest, length)
    if len(level) and level.max() > WHITE:
        raise ValueError(f"expected up to {WHITE} events of one polarity in a row, a pixel has {level.max()}")
    intensity = np.empty_like(level)
    intensity[order] = level
    return intensity


def _stamps(stamp: np.ndarray, announced: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Time stamps to send, and the index of the event that each precedes.

    The stamps are close enough to stay unambiguous when they wrap. The first is 0; one comes before each of the
    `announced` events.
    """
    step = 2 ** (bits - 1)
    sent = stamp[announced]
    before = np.concatenate([[0], sent[:-1]])[: len(sent)]
    between = np.maximum(sent - before - 1, 0) // step
    rank = np.arange(between.sum()) - np.repeat(np.cumsum(between) - between, between)
    times = np.concatenate([[0], np.repeat(before, between) + step * (1 + rank), sent])
    places = np.concatenate([[0], np.repeat(announced, between), announced])
    order = np.lexsort((times, places))
    return times[order], places[order]


def _items_1(
    stamp: np.ndarray, row: np.ndarray, column: np.ndarray, intensity: np.ndarray
) -> Int64[np.ndarray, " items"]:
    announced = np.flatnonzero((np.diff(stamp, prepend=-1) != 0) | (np.diff(row, prepend=-1) != 0))
    times, places = _stamps(stamp, announced, STAMP_BITS[1])
    rows = np.append(row, 0)[places]
    items = (WHITE - intensity) << 16 | column << 5 | COLUMN
    return np.insert(items, places, rows << 18 | (times & 0xFFFF) << 2 | ROW)


def _items_2(stamp: np.ndarray, row: np.ndarray, column: np.ndarray) -> Int64[np.ndarray, " items"]:
    times, places = _stamps(stamp, np.flatnonzero(np.diff(stamp, prepend=-1)), STAMP_BITS[2])
    new_row = np.flatnonzero(np.diff(row, prepend=-1))
    announcements = np.concatenate([(times & 0xFFF) << 2 | TIME, row[new_row] << 4 | ROW])
    places = np.concatenate([places, new_row])
    order = np.argsort(places, kind="stable")
    return np.insert(column << 3 | COLUMN, places[order], announcements[order])


def _packed(words: Int64[np.ndarray, " words"], event_format: int) -> UInt8[np.ndarray, "groups 7"]:
    """Pack 14-bit words as the sensor sends them, in full packages; padding in the last one states the mode."""
    padding = [INTENSITY << 14 & 0x3FFF, INTENSITY << 14 >> 14] if event_format == 1 else [0]
    missing = -len(words) % (4 * PACKAGE_GROUPS)
    words = np.concatenate([words, np.resize(np.array(padding, np.int64), missing)]).reshape(-1, 4)
    low = words & 63
    low_bytes = low[:, 0] | low[:, 1] << 6 | low[:, 2] << 12 | low[:, 3] << 18
    high = [words[:, k] >> 6 for k in range(4)]
    return np.stack([*high, low_bytes, low_bytes >> 8, low_bytes >> 16], axis=1).astype(np.uint8)


def _write_packages(path: Path, groups: np.ndarray, event_format: int) -> None:
    packages = len(groups) // PACKAGE_GROUPS
    with path.open("wb") as file:
        file.write(_header(INTENSITY if event_format == 1 else OFF_PIXEL, event_format, 0, packages))
        for package in groups.reshape(packages, -1):
            file.write(LENGTH.pack(package.size + 1))
            file.write(package.tobytes() + b"\1")
