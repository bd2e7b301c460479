"""Convert events to and from other tools' files: HDF5 in DSEC's layout, and text lines `t x y p`."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from polarnet.events.stream import Events, validate
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.events import EventStore, first_at_millisecond

CONTENTS = "store.json"
HDF5_CHUNK = 2**16  # events


def write_hdf5(path: str | os.PathLike[str], events: Events, duration_us: int) -> None:
    """Write one channel in DSEC's layout of a camera (Gehrig et al. 2021): events/{x,y,t,p}, ms_to_idx and t_offset.

    Polarity is 1 or 0 there. The attributes height and width add the sensor's size. Needs h5py.
    """
    columns: dict[str, np.ndarray] = {
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


def read_hdf5(path: str | os.PathLike[str], height: int | None = None, width: int | None = None) -> Events:
    """Read the events of a DSEC file, at times t + t_offset; the sensor's size comes from the file where stated.

    ValueError that names the file where it has no events, no size (give one; DSEC is 480x640) or broken events.
    """
    with _h5py().File(path, "r") as file:
        absent = [name for name in ("events/x", "events/y", "events/t", "events/p") if name not in file]
        if absent:
            raise ValueError(f"{path}: expected DSEC's HDF5, there is no {', '.join(absent)}")
        t, x, y, p = (file[f"events/{name}"][:] for name in "txyp")
        offset_us = int(file["t_offset"][()]) if "t_offset" in file else 0
        if "height" in file.attrs and "width" in file.attrs:
            height, width = int(file.attrs["height"]), int(file.attrs["width"])
    return _events(path, t.astype(np.int64) + offset_us, x, y, p, height, width)


def write_text(path: str | os.PathLike[str], events: Events, duration_us: int) -> None:
    """Write one channel as a line `width height`, then a line `t x y p` per event, the format of E2VID's tools.

    t is in seconds with six decimals; p is 1 or 0. Such a file cannot hold the duration.
    """
    with Path(path).open("w", encoding="ascii") as file:
        file.write(f"{events.width} {events.height}\n")
        rows = zip(*(column.tolist() for column in (events.t, events.x, events.y, events.p)), strict=True)
        file.writelines(f"{t // 1_000_000}.{t % 1_000_000:06d} {x} {y} {int(p > 0)}\n" for t, x, y, p in rows)


def read_text(path: str | os.PathLike[str], height: int | None = None, width: int | None = None) -> Events:
    """Read events from lines `t x y p`, after a line `width height` or with the given size; # starts a comment.

    t is in seconds where the first event's t has a decimal point, else in microseconds; p is 1 or 0, or 1 or -1.
    ValueError that names the file where it has any other content.
    """
    lines = [text for line in Path(path).read_text(encoding="ascii", errors="replace").splitlines()
             if (text := line.split("#")[0].strip())]  # fmt: skip
    try:
        if lines and len(lines[0].split()) == 2:
            width, height = (int(side) for side in lines.pop(0).split())
        table = np.loadtxt(lines, ndmin=2) if lines else np.empty((0, 4))
    except ValueError as error:
        raise ValueError(f"{path}: expected lines 't x y p': {error}") from None
    if table.shape[1] != 4:
        raise ValueError(f"{path}: expected the four columns t x y p, got {table.shape[1]}")
    t, x, y, p = table.T
    unit_us = 1_000_000 if lines and "." in lines[0].split()[0] else 1
    return _events(path, np.rint(t * unit_us).astype(np.int64), x, y, p, height, width)


class Form(NamedTuple):
    """Suffix, writer and reader of one file format."""

    suffix: str
    write: Callable[[Path, Events, int], None]
    read: Callable[[Path], Events]


FORMS = {"hdf5": Form(".h5", write_hdf5, read_hdf5), "text": Form(".txt", write_text, read_text)}


def export_store(store: EventStore, folder: str | os.PathLike[str], form: str) -> None:
    """Write FOLDER/SEQUENCE/polarizer_{000,045,090,135}.{h5,txt} for every sequence, then FOLDER/store.json.

    `form` is hdf5 or text. store.json holds the data that these files cannot; `import_store` reads it.
    """
    folder = Path(folder)
    suffix, write, _ = _form(form)
    for sequence in store.sequences:
        if Path(sequence).name != sequence:
            raise ValueError(f"{store.path}: {sequence!r} cannot be the name of a folder")
        duration_us = store.duration_us(sequence)
        (folder / sequence).mkdir(parents=True, exist_ok=True)
        for path, events in zip(_files(folder / sequence, suffix), store.read(sequence), strict=True):
            write(path, events, duration_us)
    contents = {
        "form": form,
        "height": store.height,
        "width": store.width,
        "polarizer_angles_deg": POLARIZER_ANGLES_DEG,
        "sequences_per_part": store.sequences_per_part,
        "duration_us": {sequence: store.duration_us(sequence) for sequence in store.sequences},
        "attributes": store.attributes,
    }
    (folder / CONTENTS).write_text(json.dumps(contents, indent=2) + "\n", encoding="utf-8")


def import_store(folder: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Rebuild an event store, byte for byte, from a folder that `export_store` wrote.

    Other files are recordings: `polarnet.recordings` reads, checks and repairs them.
    """
    folder = Path(folder)
    try:
        contents: dict[str, Any] = json.loads((folder / CONTENTS).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileNotFoundError(f"{folder}: expected a folder that export_store wrote, it has no {CONTENTS}") from None
    suffix, _, read = _form(contents["form"])
    durations = contents["duration_us"]
    size, attributes = (contents["height"], contents["width"]), contents["attributes"]
    store = EventStore.create(path, list(durations), *size, attributes, contents["sequences_per_part"])
    for sequence in store.missing():
        store.write(sequence, [read(file) for file in _files(folder / sequence, suffix)], durations[sequence])
    store.finish()


def _form(name: str) -> Form:
    if name not in FORMS:
        raise ValueError(f"expected a form of {', '.join(FORMS)}, got {name!r}")
    return FORMS[name]


def _files(folder: Path, suffix: str) -> list[Path]:
    return [folder / f"polarizer_{angle:03d}{suffix}" for angle in POLARIZER_ANGLES_DEG]


def _events(
    path: str | os.PathLike[str],
    t_us: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
    height: int | None,
    width: int | None,
) -> Events:
    """Convert a file's columns to events; darker may be 0 or -1 there."""
    if height is None or width is None:
        raise ValueError(f"{path}: the file does not say how large the sensor is; give height and width")
    if not (np.isin(p, (0, 1)).all() or np.isin(p, (-1, 1)).all()):
        raise ValueError(f"{path}: expected polarities 0 and 1, or -1 and 1, got {np.unique(p)[:8].tolist()}")
    if len(x) and not (min(x.min(), y.min()) >= 0 and x.max() < width and y.max() < height):
        raise ValueError(f"{path}: events up to x={x.max():g}, y={y.max():g} are not on a sensor of {height}x{width}")
    if not (np.equal(x, np.floor(x)).all() and np.equal(y, np.floor(y)).all()):
        raise ValueError(f"{path}: expected x and y to be whole numbers")
    columns = t_us, x.astype(np.int16), y.astype(np.int16), np.where(p > 0, 1, -1).astype(np.int8)
    t, column, row, polarity = (torch.from_numpy(values) for values in columns)
    try:
        return validate(Events(t, column, row, polarity, height, width))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _h5py() -> Any:
    try:
        import h5py
    except ImportError:
        raise RuntimeError("HDF5 needs h5py: pip install 'polarnet[hdf5]'") from None
    return h5py
