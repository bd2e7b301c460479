"""Write BIN and CSV files of a CeleX-5, for simulated cameras and for tests of the readers."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int, Int64, UInt8, UInt16

from polarnet.events.stream import Events, validate
from polarnet.recordings.formats.celex5 import (
    CLOCK_MHZ,
    COLUMN,
    FULL_PICTURE,
    HEADER,
    HEIGHT,
    IMU,
    INTENSITY,
    LENGTH,
    PICTURE_BYTES,
    ROW,
    STAMP,
    TICK_CYCLES,
    WHITE,
    WIDTH,
    microseconds,
)
from polarnet.recordings.formats.lines import lines_of

PACKAGE_GROUPS = 51_000  # 7 bytes each; the sensor sends only packages of this length
NO_MODE = 255
CSV_LINES = 2**18  # written at a time


def write_celex5_bin(path: Path, events: Events) -> Events:
    """Write events as the sensor sends them, and return the events that a reader gets from the file.

    Each time becomes the sensor's first time stamp at or after it (every 10.24 us at 100 MHz), from 0 on. Polarity is a
    change of intensity, which starts from 0, so a pixel that first becomes darker gets a brighter event at the start.
    ValueError for events that are out of order, before 0, off a sensor of 800 x 1280, or more than 4095 of one polarity
    in a row in a pixel.
    """
    _check_size(events)
    validate(events)
    if len(events) and events.t[0] < 0:
        raise ValueError(f"expected times from 0 on, got {int(events.t[0])} us")
    stamp = -(-events.t.numpy() * CLOCK_MHZ // TICK_CYCLES)
    row, column = events.y.numpy().astype(np.int64), events.x.numpy().astype(np.int64)
    p = events.p.numpy()
    first_is_darker = np.zeros(len(p), np.bool_)
    first_is_darker[np.unique(row * WIDTH + column, return_index=True)[1]] = True
    first_is_darker &= p < 0
    stamp = np.concatenate([np.zeros(first_is_darker.sum(), np.int64), stamp])
    row, column = (np.concatenate([values[first_is_darker], values]) for values in (row, column))
    p = np.concatenate([np.ones(first_is_darker.sum(), np.int8), p])
    items = _items(stamp, row, column, _intensities(row * WIDTH + column, p))
    _write_packages(path, _packed(np.stack([items & 0x3FFF, items >> 14], axis=1).reshape(-1)))
    return Events(
        torch.from_numpy(microseconds(stamp)),
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
        file.write(_header(FULL_PICTURE, IMU if stamps else 0, 0))
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
        file.write(_header(FULL_PICTURE, IMU if stamps else 0, packages))


def write_celex5_csv(path: Path, events: Events, intensity: Int[np.ndarray, " n"] | None = None) -> None:
    """Write events in the converter's Event Intensity format: lines row,col,adc,polarity,t in microseconds.

    `intensity` is the pixel's measurement, 0 to 4095; None writes half of the maximum. ValueError where events are not
    on the sensor of 800 x 1280.
    """
    _check_size(events)
    adc = np.full(len(events), WHITE // 2) if intensity is None else np.asarray(intensity)
    if len(adc) != len(events) or (len(adc) and not (adc.min() >= 0 and adc.max() <= WHITE)):
        raise ValueError(f"expected an intensity of 0 to {WHITE} for each of {len(events)} events, got {len(adc)}")
    columns = [events.y.numpy(), events.x.numpy(), adc, events.p.numpy(), events.t.numpy()]
    with path.open("wb") as file:
        for start in range(0, len(events), CSV_LINES):
            part = [column[start : start + CSV_LINES] for column in columns]
            file.write(lines_of(np.stack(part, axis=1).astype(np.int64), ","))


def _check_size(events: Events) -> None:
    if events.height > HEIGHT or events.width > WIDTH:
        raise ValueError(f"expected events of a sensor of {HEIGHT}x{WIDTH}, got {events.height}x{events.width}")


def _header(mode: int, data_type: int, packages: int) -> bytes:
    return HEADER.pack(data_type, mode, NO_MODE, NO_MODE, 1, 0, 0, 0, packages)


def _packed_picture(picture: np.ndarray) -> np.ndarray:
    dark = np.uint16(WHITE) - picture.reshape(-1, 2)
    dark[0, 0] = FULL_PICTURE << 9
    low = dark[:, 0] & 15 | (dark[:, 1] & 15) << 4
    return np.stack([dark[:, 0] >> 4, dark[:, 1] >> 4, low], axis=1).astype(np.uint8)


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


def _stamps(stamp: np.ndarray, announced: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Time stamps to send, from 0 and close enough to stay unambiguous; and the index of the event behind each."""
    step = 2**15
    sent = stamp[announced]
    before = np.concatenate([[0], sent[:-1]])[: len(sent)]
    between = np.maximum(sent - before - 1, 0) // step
    rank = np.arange(between.sum()) - np.repeat(np.cumsum(between) - between, between)
    times = np.concatenate([[0], np.repeat(before, between) + step * (1 + rank), sent])
    places = np.concatenate([[0], np.repeat(announced, between), announced])
    order = np.lexsort((times, places))
    return times[order], places[order]


def _items(
    stamp: np.ndarray, row: np.ndarray, column: np.ndarray, intensity: np.ndarray
) -> Int64[np.ndarray, " items"]:
    announced = np.flatnonzero((np.diff(stamp, prepend=-1) != 0) | (np.diff(row, prepend=-1) != 0))
    times, places = _stamps(stamp, announced)
    rows = np.append(row, 0)[places]
    items = (WHITE - intensity) << 16 | column << 5 | COLUMN
    return np.insert(items, places, rows << 18 | (times & 0xFFFF) << 2 | ROW)


def _packed(words: Int64[np.ndarray, " words"]) -> UInt8[np.ndarray, "groups 7"]:
    """Pack 14-bit words as the sensor sends them, in full packages; padding in the last one states the mode."""
    padding = np.array([INTENSITY << 14 & 0x3FFF, INTENSITY << 14 >> 14])
    words = np.concatenate([words, np.resize(padding, -len(words) % (4 * PACKAGE_GROUPS))]).reshape(-1, 4)
    low = words & 63
    low_bytes = low[:, 0] | low[:, 1] << 6 | low[:, 2] << 12 | low[:, 3] << 18
    high = [words[:, k] >> 6 for k in range(4)]
    return np.stack([*high, low_bytes, low_bytes >> 8, low_bytes >> 16], axis=1).astype(np.uint8)


def _write_packages(path: Path, groups: np.ndarray) -> None:
    packages = len(groups) // PACKAGE_GROUPS
    with path.open("wb") as file:
        file.write(_header(INTENSITY, 0, packages))
        for package in groups.reshape(packages, -1):
            file.write(LENGTH.pack(package.size + 1))
            file.write(package.tobytes() + b"\1")
