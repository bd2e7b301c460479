"""Write BIN files of a CeleX-5, for simulated cameras and for tests of the readers."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64, UInt8, UInt16

from polarnet.events.stream import Events, validate
from polarnet.recordings.formats import celex5
from polarnet.recordings.formats.celex5 import COLUMN, HEIGHT, ROW, WHITE, WIDTH
from polarnet.runtime.compilation import compiled

PACKAGE_GROUPS = 51_000  # 7 bytes each; the sensor sends only packages of this length
NO_MODE = 255
STEP = 2**15  # time stamps from one row to the next, at most


def write_celex5_bin(path: Path, events: Events) -> Events:
    """Write events as the sensor sends them, and return the events that a reader gets from the file.

    Each time becomes the sensor's first time stamp at or after it (every 10.24 us), from 0 on. Polarity is a
    change of intensity, which starts from 0, so a pixel that first becomes darker gets a brighter event at the start.
    ValueError for events that are out of order or off their sensor.
    """
    validate(events)
    assert events.height <= HEIGHT
    assert events.width <= WIDTH
    assert not (events.t < 0).any()
    stamp = -(-events.t.numpy() * celex5.CLOCK_MHZ // celex5.TICK_CYCLES)
    pixel, p = events.y.numpy().astype(np.int64) * WIDTH + events.x.numpy(), events.p.numpy()
    _, first = np.unique(pixel, return_index=True)
    darker = np.sort(first[p[first] < 0])
    stamp = np.concatenate([np.zeros(len(darker), np.int64), stamp])
    pixel = np.concatenate([pixel[darker], pixel])
    p = np.concatenate([np.ones(len(darker), np.int8), p])
    items = np.empty(2 * len(p) + 1 + (int(stamp[-1]) // STEP if len(p) else 0), np.int64)
    count, brightest = _fill_items(stamp, pixel, p, np.zeros(HEIGHT * WIDTH, np.int64), items)
    assert brightest <= WHITE, f"a pixel has {brightest} events of one polarity in a row"
    items = items[:count]
    packages = _packages(np.stack([items & 0x3FFF, items >> 14], axis=1).reshape(-1))
    with path.open("wb") as file:
        file.write(_header(celex5.INTENSITY, 0, len(packages)))
        for package in packages:
            file.write(celex5.LENGTH.pack(package.size + 1) + package.tobytes() + b"\1")
    return Events.from_columns(celex5.microseconds(stamp), pixel % WIDTH, pixel // WIDTH, p, HEIGHT, WIDTH)


def write_celex5_pictures(path: Path, pictures: Iterable[UInt16[np.ndarray, "800 1280"]], t_us: Sequence[int]) -> None:
    """Write full pictures of 0 to 4095 (brighter is larger), with the computer's time to the millisecond.

    Pixel (0, 0) is lost, since the sensor stores its mode there.
    """
    with path.open("wb") as file:
        file.write(_header(celex5.FULL_PICTURE, celex5.IMU, len(t_us)))
        for picture, t in zip(pictures, t_us, strict=True):
            assert picture.shape == (HEIGHT, WIDTH)
            assert picture.max() <= WHITE
            file.write(celex5.LENGTH.pack(celex5.PICTURE_BYTES) + _packed_picture(picture).tobytes() + b"\0")
            file.write(celex5.STAMP.pack(t // 1000, 0))


def _header(mode: int, data_type: int, packages: int) -> bytes:
    return celex5.HEADER.pack(data_type, mode, NO_MODE, NO_MODE, 1, 0, 0, 0, packages)


def _packed_picture(picture: np.ndarray) -> np.ndarray:
    dark = np.uint16(WHITE) - picture.reshape(-1, 2)
    dark[0, 0] = celex5.FULL_PICTURE << 9
    low = dark[:, 0] & 15 | (dark[:, 1] & 15) << 4
    return np.stack([dark[:, 0] >> 4, dark[:, 1] >> 4, low], axis=1).astype(np.uint8)


@compiled
def _fill_items(stamp, pixel, p, intensity, items):
    """Fill `items` with rows and columns; returns their number and the largest intensity. `intensity` starts with 0.

    A row and its time come before their events, and at least every `STEP` stamps, so that 16 bits of a time suffice.
    """
    lowest = np.zeros_like(intensity)
    for k in range(len(p)):
        intensity[pixel[k]] += p[k]
        lowest[pixel[k]] = min(lowest[pixel[k]], intensity[pixel[k]])
    intensity[:] = -lowest
    items[0] = ROW
    count, time, row, brightest = 1, 0, -1, 0
    for k in range(len(p)):
        intensity[pixel[k]] += p[k]
        brightest = max(brightest, intensity[pixel[k]])
        while stamp[k] != time or pixel[k] // WIDTH != row:
            row = pixel[k] // WIDTH
            time = min(stamp[k], time + STEP)
            items[count] = row << 18 | (time & 0xFFFF) << 2 | ROW
            count += 1
        items[count] = (WHITE - intensity[pixel[k]]) << 16 | pixel[k] % WIDTH << 5 | COLUMN
        count += 1
    return count, brightest


def _packages(words: Int64[np.ndarray, " words"]) -> UInt8[np.ndarray, "packages bytes"]:
    """Pack 14-bit words as the sensor sends them, in full packages; padding in the last one states the mode."""
    padding = np.array([celex5.INTENSITY << 14 & 0x3FFF, celex5.INTENSITY << 14 >> 14])
    words = np.concatenate([words, np.resize(padding, -len(words) % (4 * PACKAGE_GROUPS))]).reshape(-1, 4)
    low = (words & 63) @ (1 << 6 * np.arange(4))
    groups = np.column_stack([words >> 6, low, low >> 8, low >> 16]).astype(np.uint8)
    return groups.reshape(-1, 7 * PACKAGE_GROUPS)
