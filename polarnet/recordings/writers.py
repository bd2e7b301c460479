"""Write events as other tools' files: HDF5 in DSEC's layout, text lines `t x y p`, and Prophesee's EVT3.

`polarnet.recordings` reads them all.
"""

import io
import itertools
import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from polarnet.events.stream import Events, slice_count
from polarnet.runtime.compilation import compiled, inlined
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.events import EventStore
from polarnet.terminal.installation import installation
from polarnet.terminal.progress import ProgressBar

HDF5_CHUNK = 2**16  # events
BLOCK = 2**18  # events converted at once
EVT3_MAX_SIDE = 2**11  # x and y have 11 bits
EVT3_WORDS = 2**20  # 16-bit words written at once
MAX_TEXT_US = 10**18  # seconds of 12 digits
MAX_LINE = 12 + 7 + 3 * 6 + 2  # bytes of a line of text
MAX_DURATION_US = 30 * 86_400_000_000
"""30 days: HDF5 has an index entry for each millisecond, and EVT3 a word for every 4 ms, also without events."""

Recorded: TypeAlias = Events | Iterable[Events]
"""Events of one sensor, or consecutive chunks of them, at least one."""


def write_hdf5(path: str | os.PathLike[str], events: Recorded, duration_us: int | None) -> None:
    """Write one channel in DSEC's layout of a camera (Gehrig et al. 2021): events/{x,y,t,p}, ms_to_idx and t_offset.

    Polarity is 1 or 0 there; t is int64, because DSEC's uint32 ends after 71 minutes. The attributes height and width
    add the sensor's size. `duration_us` None: up to the last event. ValueError for more than 30 days. Needs h5py.
    """
    with _Disk(path, "wb+") as disk, h5py_module().File(disk, "w") as file:
        columns = {
            name: _growing(file, f"events/{name}", dtype)
            for name, dtype in (("x", np.uint16), ("y", np.uint16), ("t", np.int64), ("p", np.uint8))
        }
        index = _growing(file, "ms_to_idx", np.uint64)
        file["t_offset"] = np.int64(0)
        end_us, count = 0, 0
        for block in _blocks(events, "HDF5", MAX_DURATION_US):
            file.attrs["height"], file.attrs["width"] = block.height, block.width
            t = block.t.numpy()
            for name, dataset in columns.items():
                values = (block.p > 0).numpy() if name == "p" else getattr(block, name).numpy()
                _append(dataset, values.astype(dataset.dtype))
            if len(t):
                end_us = int(t[-1])
                for edges in _milliseconds(len(index), end_us // 1000 + 1):
                    _append(index, (count + np.searchsorted(t, 1000 * edges)).astype(np.uint64))
            count += len(t)
            disk.check()
        end_us = end_us + 1 if duration_us is None else duration_us
        for edges in _milliseconds(len(index), -(-end_us // 1000) + 1):  # up to the first at or after the end
            _append(index, np.full(len(edges), count, np.uint64))
    disk.check()


class _Disk(io.FileIO):
    """A file for HDF5, which crashes where a write fails: the first error is kept for `check`, later bytes are lost."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all bytes."""
        rest = memoryview(data).cast("B")
        try:
            while len(rest) and self.error is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.error = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Cut or lengthen the file."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return self.tell()

    def check(self) -> None:
        """Raise the error of a write."""
        if self.error is not None:
            raise self.error


def _growing(file: Any, name: str, dtype: type[np.generic]) -> Any:
    """An empty dataset that `_append` extends; coordinates are not compressed, for speed."""
    packed = {} if name in ("events/x", "events/y") else {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    return file.create_dataset(name, (0,), dtype, maxshape=(None,), chunks=(HDF5_CHUNK,), **packed)


def _append(dataset: Any, values: np.ndarray) -> None:
    dataset.resize(len(dataset) + len(values), axis=0)
    dataset[len(dataset) - len(values) :] = values


def _milliseconds(start: int, stop: int) -> Iterator[np.ndarray]:
    """Whole milliseconds, in blocks."""
    for first in range(start, stop, BLOCK):
        yield np.arange(first, min(first + BLOCK, stop))


def write_text(path: str | os.PathLike[str], events: Recorded, duration_us: int | None) -> None:
    """Write one channel as a line `width height`, then a line `t x y p` per event, the format of E2VID's tools.

    t is in seconds with six decimals; p is 1 or 0. Such a file cannot hold the duration.
    """
    text = np.empty(MAX_LINE * BLOCK, np.uint8)
    with Path(path).open("wb") as file:
        for number, block in enumerate(_blocks(events, "text", MAX_TEXT_US)):
            if number == 0:
                file.write(f"{block.width} {block.height}\n".encode("ascii"))
            file.write(text[: _encode_text(*(getattr(block, name).numpy() for name in "txyp"), text)].data)


def write_evt3(path: str | os.PathLike[str], events: Recorded, duration_us: int | None) -> None:
    """Write one sensor as Prophesee's raw file of 16-bit EVT3 words, without vector words (of neighbouring pixels).

    The header states the sensor's size. Such a file cannot hold the duration. ValueError for a side above 2048 px, and
    for more than 30 days.
    """
    state = np.array([-1, -1, -1])  # high and low bits of the time, and row, of the event before
    words = np.empty(EVT3_WORDS, np.uint16)
    with Path(path).open("wb") as file:
        for number, block in enumerate(_blocks(events, "EVT3", MAX_DURATION_US)):
            if number == 0:
                file.write(_evt3_header(block.height, block.width).encode("ascii"))
            columns, done = [getattr(block, name).numpy() for name in "txyp"], 0
            while done < len(block):
                done, count = _encode_evt3(*columns, done, state, words)
                file.write(words[:count].astype("<u2").data)


def _evt3_header(height: int, width: int) -> str:
    if max(height, width) > EVT3_MAX_SIDE:
        raise ValueError(
            f"EVT3 holds sensors of up to {EVT3_MAX_SIDE} px a side, got {height}x{width}; choose another format"
        )
    return f"% evt 3.0\n% format EVT3;height={height};width={width}\n% geometry {width}x{height}\n% end\n"


def _blocks(events: Recorded, form: str, max_us: int) -> Iterator[Events]:
    """The events in blocks of up to `BLOCK`; ValueError for times that the format cannot hold, or out of order."""
    before_us = 0
    for chunk in [events] if isinstance(events, Events) else events:
        for start in range(0, max(1, len(chunk)), BLOCK):
            block = slice_count(chunk, start, start + BLOCK)
            if len(block):
                first_us, last_us = int(block.t[0]), int(block.t[-1])
                if not before_us <= first_us <= last_us <= max_us:
                    raise ValueError(
                        f"{form} holds times from 0 to {max_us} us in order, got {first_us} to {last_us} us after "
                        f"{before_us} us; write a part of the recording"
                    )
                before_us = last_us
            yield block


@compiled
def _encode_text(t, x, y, p, text):
    """Write the lines of `write_text`; returns their number of bytes."""
    n = 0
    for i in range(len(t)):
        n = _digits(t[i] // 1_000_000, 1, text, n)
        text[n] = 46  # the decimal point
        n = _digits(t[i] % 1_000_000, 6, text, n + 1)
        for value in (np.int64(x[i]), np.int64(y[i])):
            text[n] = 32
            n = _digits(value, 1, text, n + 1)
        text[n], text[n + 1], text[n + 2] = 32, 48 + (p[i] > 0), 10
        n += 3
    return n


@inlined
def _digits(value, least, text, n):
    """Write at least `least` digits of a number at place `n`; returns the place after them."""
    length, rest = 1, value // 10
    while rest > 0 or length < least:
        length, rest = length + 1, rest // 10
    for k in range(n + length - 1, n - 1, -1):
        text[k] = 48 + value % 10
        value //= 10
    return n + length


@compiled
def _encode_evt3(t, x, y, p, start, state, words):
    """Fill `words` with the events from `start` on; returns the first event that did not fit, and the number of words.

    Words by their upper 4 bits: 8 and 6 the high and low 12 bits of the time, 0 the row, 2 polarity and column. The
    high bits are written each time they step, even between events, because readers count how often they wrap.
    """
    high, low, row = state
    n = 0
    for i in range(start, len(t)):
        while high < t[i] >> 12 and n < len(words):
            high += 1
            words[n] = 0x8000 | (high & 0xFFF)
            low = -1
            n += 1
        if n + 3 > len(words):
            state[:] = high, low, row
            return i, n
        if low != t[i] & 0xFFF:
            low = t[i] & 0xFFF
            words[n] = 0x6000 | low
            n += 1
        if row != y[i]:
            row = y[i]
            words[n] = row
            n += 1
        words[n] = 0x2000 | (p[i] > 0) << 11 | x[i]
        n += 1
    state[:] = high, low, row
    return len(t), n


FORMS: dict[str, tuple[str, Callable[[Path, Recorded, int | None], None]]] = {
    "hdf5": (".h5", write_hdf5),
    "text": (".txt", write_text),
    "evt3": (".raw", write_evt3),
}
"""Suffix and writer of each file format."""


def export_store(
    store: EventStore, folder: str | os.PathLike[str], form: str, sequences: Sequence[str] | None = None
) -> None:
    """Write FOLDER/SEQUENCE/polarizer_{000,045,090,135}.{h5,txt,raw} for every sequence, then FOLDER/store.json.

    `sequences` are those to write; None: all. `form` is hdf5, text or evt3. store.json holds the data that these files
    cannot: durations, sizes, attributes.
    """
    folder = Path(folder)
    if form not in FORMS:
        raise ValueError(f"expected a form of {', '.join(FORMS)}, got {form!r}")
    suffix, write = FORMS[form]
    chosen = store.sequences if sequences is None else sequences
    for sequence in ProgressBar(chosen, "export", unit="sequence"):
        if Path(sequence).name != sequence:
            raise ValueError(f"{store.path}: {sequence!r} cannot be the name of a folder")
        duration_us = store.duration_us(sequence)
        (folder / sequence).mkdir(parents=True, exist_ok=True)
        for channel, angle in enumerate(POLARIZER_ANGLES_DEG):
            path = folder / sequence / f"polarizer_{angle:03d}{suffix}"
            nothing = Events.empty(store.height, store.width)  # so that a channel without events has a size
            write(path, itertools.chain([nothing], _channel_chunks(store, sequence, channel)), duration_us)
    contents = {
        "form": form,
        "height": store.height,
        "width": store.width,
        "polarizer_angles_deg": POLARIZER_ANGLES_DEG,
        "sequences_per_part": store.sequences_per_part,
        "duration_us": {sequence: store.duration_us(sequence) for sequence in chosen},
        "attributes": store.attributes,
    }
    (folder / "store.json").write_text(json.dumps(contents, indent=2) + "\n", encoding="utf-8")


def _channel_chunks(store: EventStore, sequence: str, channel: int) -> Iterator[Events]:
    """The events of one channel of a sequence, in chunks."""
    first, end = store.record(sequence)["offsets"][channel : channel + 2]
    for start in range(first, end, BLOCK):
        yield from store.rows(sequence, [(start, min(start + BLOCK, end))])


def h5py_module() -> Any:
    """The package h5py; RuntimeError with the way to install it if it is missing."""
    try:
        import h5py
    except ImportError:
        raise RuntimeError(f"HDF5 needs h5py: {installation('recordings')}") from None
    return h5py
