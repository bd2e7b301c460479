"""HDF5 files in the layouts of `LAYOUTS`: where their columns t (whole microseconds), x, y and p (1 or 0) are."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from polarnet.recordings.formats.isolated import Library, ask, ask_once
from polarnet.recordings.source import BLOCK_EVENTS, Block, CameraFrames, Choices, RecordingError, Source, sensor_size

MAGIC = b"\x89HDF\r\n\x1a\n"
TRIGGERS = "triggers"  # times of a trigger signal in microseconds
MAX_WHOLE = 2**53  # largest whole number that a float holds exactly
E2P_FRAMES, E2P_MAPS = ("frame_ts", "frame"), ("intensity", "dolp", "aolp")
E2P_WHITE = 255.0  # level in its maps of saturated light, of DoLP 1 and of AoLP 90 degrees; level 0 is AoLP -90 degrees
SETTINGS = ("t_offset", "height", "width", "sensor_resolution", "geometry")
"""Attributes or scalars that a file may have: microseconds added to t, and the sensor's size in three notations."""

HDF5 = Library(
    "HDF5",
    "h5py",
    "hdf5",
    "polarnet.recordings.formats.hdf5_tasks",
    "the file is damaged, or compressed with a filter that is not installed: pip install hdf5plugin; for Prophesee's "
    "ECF install the HDF5 plugin of Metavision or OpenEB and name its folder in HDF5_PLUGIN_PATH",
)


class Column(NamedTuple):
    """A column of numbers: a table of its own, a field of a table of records, or a column of a table by number."""

    table: str
    part: str | int | None = None


class Layout(NamedTuple):
    """Where a kind of HDF5 file holds its events."""

    owner: str
    columns: Sequence[Column]
    """t, x, y, p."""


LAYOUTS = {
    "e2p": Layout("E2P", [Column("events", number) for number in range(4)]),
    "esfp": Layout("ESfP", [Column(name) for name in "txyp"]),
    "metavision": Layout("Prophesee", [Column("CD/events", name) for name in "txyp"]),
    "dsec": Layout("DSEC", [Column(f"events/{name}") for name in "txyp"]),
}
"""E2P: Mei et al. 2023, a sensor behind polarizers 90 45 / 135 0. ESfP: Muglikar et al. 2023. Prophesee: Metavision,
whose compression ECF needs Prophesee's HDF5 plugin. DSEC: Gehrig et al. 2021, whose files do not state 480 x 640."""


def matcher(layout: str) -> Callable[[Path, bytes], bool]:
    """A check of whether a file is HDF5 with the tables of a layout; for DSEC's, the last one tried, any HDF5."""
    tables = {column.table for column in LAYOUTS[layout].columns}

    def matches(path: Path, head: bytes) -> bool:
        if not head.startswith(MAGIC) or layout == "dsec":
            return head.startswith(MAGIC)
        try:
            return tables <= set(_described(path)["tables"])
        except (RecordingError, RuntimeError):
            return False  # the opener of DSEC's layout reports the reason

    return matches


def opener(layout: str) -> Callable[[Path, Choices], Source]:
    """A function that opens the events of a file of a layout."""
    owner, columns = LAYOUTS[layout]

    def open_file(path: Path, choices: Choices) -> Source:
        description = _described(path)
        absent = dict.fromkeys(column.table for column in columns if column.table not in description["tables"])
        if absent:
            raise RecordingError(
                f"{path.name}: expected HDF5 in the layout of {owner}, there is no {', '.join(absent)}"
            )
        lengths = [_length(path, description, column) for column in columns]
        if len(set(lengths)) > 1:
            raise RecordingError(f"{path.name}: its columns t, x, y, p have different lengths, {lengths}")
        offset_us = _whole(path, description, "t_offset") or 0

        def blocks(counts: Counter[str]) -> Iterator[Block]:
            for t, x, y, p in _read(path, columns):
                yield Block(_microseconds(path, t) + offset_us, x, y, p)

        return Source(*sensor_size(path, choices, *_stated_size(path, description)), blocks)

    return open_file


def trigger_times_us(path: Path) -> np.ndarray:
    """Times in the table /triggers; RecordingError if there is none."""
    description, column = _described(path), Column(TRIGGERS)
    if TRIGGERS not in description["tables"]:
        raise RecordingError(f"{path.name}: expected a table /{TRIGGERS} of times in microseconds, there is none")
    _length(path, description, column)
    blocks = [_microseconds(path, t) for (t,) in _read(path, [column])]
    return np.concatenate(blocks) if blocks else np.empty(0, np.int64)


def e2p_frames(path: Path) -> CameraFrames:
    """Frames of E2P's HDF5: times /frame_ts, mosaics /frame, and maps /intensity, /dolp, /aolp of half the size."""
    tables = _described(path)["tables"]
    names = [name for name in (*E2P_FRAMES, *E2P_MAPS) if name in tables]
    if "frame_ts" not in names or not ({"frame"} <= set(names) or set(E2P_MAPS) <= set(names)):
        raise RecordingError(
            f"{path.name}: expected /frame_ts, and /frame or {', '.join(f'/{name}' for name in E2P_MAPS)}, as true "
            f"polarization, got {', '.join(names) or 'none of them'}"
        )
    lengths = {name: tables[name][0][0] for name in names}
    if len(set(lengths.values())) > 1:
        raise RecordingError(f"{path.name}: expected one length of all tables of frames, got {lengths}")
    blocks = [*_read(path, [Column(name) for name in names])]
    if not blocks:
        raise RecordingError(f"{path.name}: expected frames as true polarization, there are 0")
    values = {name: np.concatenate(parts) for name, parts in zip(names, zip(*blocks, strict=True), strict=True)}
    maps = None
    if set(E2P_MAPS) <= set(names):
        s0, dolp, aolp = (values[name] / np.float32(E2P_WHITE) for name in E2P_MAPS)
        maps = s0, dolp, np.remainder(np.pi * (aolp - 0.5), np.pi).astype(np.float32)
    return CameraFrames(_microseconds(path, values["frame_ts"]), values.get("frame"), maps)


def _described(path: Path) -> dict[str, Any]:
    """Shape, number kind and fields of the tables of all layouts that the file has, and its `SETTINGS`."""
    tables = [column.table for layout in LAYOUTS.values() for column in layout.columns]
    return ask_once(HDF5, path, "describe", [*tables, TRIGGERS, *E2P_FRAMES, *E2P_MAPS], SETTINGS).value


def _read(path: Path, columns: Sequence[Column]) -> Iterator[list[np.ndarray]]:
    for answer in ask(HDF5, path, "read", columns, BLOCK_EVENTS):
        yield answer.arrays


def _length(path: Path, description: dict[str, Any], column: Column) -> int:
    """Number of rows; RecordingError if the table is not as the column needs it."""
    (shape, kind, fields), (name, part) = description["tables"][column.table], column
    if len(shape) != (2 if isinstance(part, int) else 1):
        raise RecordingError(f"{path.name}: expected {name} as a table of another shape, got {shape}")
    if isinstance(part, str):
        if part not in fields:
            raise RecordingError(f"{path.name}: expected records of x, y, p, t in {name}, there is no {part}")
    elif kind not in "iufb":
        raise RecordingError(f"{path.name}: expected numbers in {name}, got type {kind!r}")
    elif isinstance(part, int) and shape[1] != 4:
        raise RecordingError(f"{path.name}: expected the four columns t, x, y, p of {name}, got {shape[1]}")
    return shape[0]


def _stated_size(path: Path, description: dict[str, Any]) -> tuple[int | None, int | None]:
    """Height and width as the file states them: height and width, [width, height], or "WIDTHxHEIGHT"."""
    values = description["values"]
    if geometry := re.fullmatch(r"(\d{1,5})x(\d{1,5})", str(values.get("geometry"))):
        return int(geometry[2]), int(geometry[1])
    if (size := values.get("sensor_resolution")) is not None:
        if not (isinstance(size, list) and len(size) == 2):
            raise RecordingError(f"{path.name}: expected width and height as sensor_resolution, got {size}")
        width, height = (_number(path, "sensor_resolution", side) for side in size)
        return height, width
    return _whole(path, description, "height"), _whole(path, description, "width")


def _whole(path: Path, description: dict[str, Any], name: str) -> int | None:
    value = description["values"].get(name)
    return None if value is None else _number(path, name, value)


def _number(path: Path, name: str, value: Any) -> int:
    if not isinstance(value, (int, float)) or not abs(value) <= MAX_WHOLE or int(value) != value:
        raise RecordingError(f"{path.name}: expected a whole number as {name}, got {value}")
    return int(value)


def _microseconds(path: Path, t: np.ndarray) -> np.ndarray:
    if t.dtype.kind == "f" and not (np.equal(t, np.floor(t)).all() and (np.abs(t) < MAX_WHOLE).all()):
        raise RecordingError(f"{path.name}: expected whole microseconds as times")
    return t.astype(np.int64)
