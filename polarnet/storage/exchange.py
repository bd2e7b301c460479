"""Write events as other tools' files: HDF5 in DSEC's layout, text lines `t x y p`, and Prophesee's EVT3.

`polarnet.recordings` reads them all.
"""

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, no_type_check

import numba
import numpy as np
import torch

from polarnet.events.stream import Events, slice_count
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.events import EventStore
from polarnet.terminal.installation import installation
from polarnet.terminal.progress import ProgressBar

HDF5_CHUNK = 2**16  # events
BLOCK = 2**18  # events converted at once
EVT3_MAX_SIDE = 2**11  # x and y have 11 bits
EVT3_WORDS_PER_EVENT = 3  # at most: row, low bits of the time, column; the high bits of the time come in addition


def write_hdf5(path: str | os.PathLike[str], events: Events, duration_us: int) -> None:
    """Write one channel in DSEC's layout of a camera (Gehrig et al. 2021): events/{x,y,t,p}, ms_to_idx and t_offset.

    Polarity is 1 or 0 there. The attributes height and width add the sensor's size. Needs h5py.
    """
    columns = {
        "x": events.x.numpy().astype(np.uint16),
        "y": events.y.numpy().astype(np.uint16),
        "t": events.t.numpy().astype(np.uint32),
        "p": (events.p > 0).numpy().astype(np.uint8),
    }
    milliseconds = torch.arange(-(-duration_us // 1000) + 1)  # from 0 up to the first at or after the end
    compressed = {"chunks": (min(HDF5_CHUNK, len(events)),), "compression": "gzip", "shuffle": True}
    with h5py_module().File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, **(compressed if len(events) else {}))
        file["ms_to_idx"] = torch.searchsorted(events.t, 1000 * milliseconds).numpy().astype(np.uint64)
        file["t_offset"] = np.int64(0)
        file.attrs["height"], file.attrs["width"] = events.height, events.width


def write_text(path: str | os.PathLike[str], events: Events, duration_us: int) -> None:
    """Write one channel as a line `width height`, then a line `t x y p` per event, the format of E2VID's tools.

    t is in seconds with six decimals; p is 1 or 0. Such a file cannot hold the duration.
    """
    with Path(path).open("w", encoding="ascii") as file:
        file.write(f"{events.width} {events.height}\n")
        for start in range(0, len(events), BLOCK):
            block = slice_count(events, start, start + BLOCK)
            rows = zip(*(column.tolist() for column in (block.t, block.x, block.y, block.p)), strict=True)
            file.writelines(f"{t // 1_000_000}.{t % 1_000_000:06d} {x} {y} {int(p > 0)}\n" for t, x, y, p in rows)


def write_evt3(path: str | os.PathLike[str], events: Events, duration_us: int) -> None:
    """Write one sensor as Prophesee's raw file of 16-bit EVT3 words, without vector words (of neighbouring pixels).

    The header states the sensor's size. Such a file cannot hold the duration. ValueError for a side above 2048 px.
    """
    if max(events.height, events.width) > EVT3_MAX_SIDE:
        raise ValueError(
            f"EVT3 holds sensors of up to {EVT3_MAX_SIDE} px a side, got {events.height}x{events.width}; "
            f"choose another format"
        )
    size = f"{events.width}x{events.height}"
    header = f"% evt 3.0\n% format EVT3;height={events.height};width={events.width}\n% geometry {size}\n% end\n"
    state = np.array([-1, -1, -1])  # high and low bits of the time, and row, of the event before
    with Path(path).open("wb") as file:
        file.write(header.encode("ascii"))
        for start in range(0, len(events), BLOCK):
            block = slice_count(events, start, start + BLOCK)
            steps = (int(block.t[-1]) >> 12) - int(state[0])
            words = np.empty(EVT3_WORDS_PER_EVENT * len(block) + steps, np.uint16)
            count = _encode_evt3(*(getattr(block, name).numpy() for name in "txyp"), state, words)
            file.write(words[:count].astype("<u2").tobytes())


@no_type_check
@numba.njit(nogil=True, cache=True)
def _encode_evt3(t, x, y, p, state, words):
    """Words by their upper 4 bits: 8 and 6 the high and low 12 bits of the time, 0 the row, 2 polarity and column.

    The high bits are written each time they step, even between events, because readers count how often they wrap.
    """
    high, low, row = state
    n = 0
    for i in range(len(t)):
        while high < t[i] >> 12:
            high += 1
            words[n] = 0x8000 | (high & 0xFFF)
            low = -1
            n += 1
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
    return n


FORMS: dict[str, tuple[str, Callable[[Path, Events, int], None]]] = {
    "hdf5": (".h5", write_hdf5),
    "text": (".txt", write_text),
    "evt3": (".raw", write_evt3),
}
"""Suffix and writer of each file format."""


EXPORT_INDEX = "store.json"


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
        for angle, events in zip(POLARIZER_ANGLES_DEG, store.read(sequence), strict=True):
            write(folder / sequence / f"polarizer_{angle:03d}{suffix}", events, duration_us)
    contents = {
        "form": form,
        "height": store.height,
        "width": store.width,
        "polarizer_angles_deg": POLARIZER_ANGLES_DEG,
        "sequences_per_part": store.sequences_per_part,
        "duration_us": {sequence: store.duration_us(sequence) for sequence in chosen},
        "attributes": store.attributes,
    }
    (folder / EXPORT_INDEX).write_text(json.dumps(contents, indent=2) + "\n", encoding="utf-8")


def h5py_module() -> Any:
    """The package h5py; RuntimeError with the way to install it if it is missing."""
    try:
        import h5py
    except ImportError:
        raise RuntimeError(f"HDF5 needs h5py: {installation('recordings')}") from None
    return h5py
