"""Write events as other tools' files: HDF5 in DSEC's layout, and text lines `t x y p`.

`polarnet.recordings` reads both.
"""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from polarnet.events.stream import Events
from polarnet.runtime.extras import installation
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.events import EventStore, first_at_millisecond

HDF5_CHUNK = 2**16  # events


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
    compressed = {"chunks": (min(HDF5_CHUNK, len(events)),), "compression": "gzip", "shuffle": True}
    with _h5py().File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, **(compressed if len(events) else {}))
        file["ms_to_idx"] = first_at_millisecond(events.t, duration_us).astype(np.uint64)
        file["t_offset"] = np.int64(0)
        file.attrs["height"], file.attrs["width"] = events.height, events.width


def write_text(path: str | os.PathLike[str], events: Events, duration_us: int) -> None:
    """Write one channel as a line `width height`, then a line `t x y p` per event, the format of E2VID's tools.

    t is in seconds with six decimals; p is 1 or 0. Such a file cannot hold the duration.
    """
    with Path(path).open("w", encoding="ascii") as file:
        file.write(f"{events.width} {events.height}\n")
        rows = zip(*(column.tolist() for column in (events.t, events.x, events.y, events.p)), strict=True)
        file.writelines(f"{t // 1_000_000}.{t % 1_000_000:06d} {x} {y} {int(p > 0)}\n" for t, x, y, p in rows)


FORMS: dict[str, tuple[str, Callable[[Path, Events, int], None]]] = {
    "hdf5": (".h5", write_hdf5),
    "text": (".txt", write_text),
}
"""Suffix and writer of each file format."""


def export_store(store: EventStore, folder: str | os.PathLike[str], form: str) -> None:
    """Write FOLDER/SEQUENCE/polarizer_{000,045,090,135}.{h5,txt} for every sequence, then FOLDER/store.json.

    `form` is hdf5 or text. store.json holds the data that these files cannot: durations, sizes and attributes.
    """
    folder = Path(folder)
    if form not in FORMS:
        raise ValueError(f"expected a form of {', '.join(FORMS)}, got {form!r}")
    suffix, write = FORMS[form]
    for sequence in store.sequences:
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
        "duration_us": {sequence: store.duration_us(sequence) for sequence in store.sequences},
        "attributes": store.attributes,
    }
    (folder / "store.json").write_text(json.dumps(contents, indent=2) + "\n", encoding="utf-8")


def _h5py() -> Any:
    try:
        import h5py
    except ImportError:
        raise RuntimeError(f"HDF5 needs h5py: {installation('hdf5')}") from None
    return h5py
