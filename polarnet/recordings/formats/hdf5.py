"""HDF5 files in four layouts: columns of DSEC and of ESfP, E2P's table from a polarization camera, and Prophesee's."""

import contextlib
import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from polarnet.recordings.formats.isolated import IsolatedLibrary
from polarnet.recordings.source import BLOCK_EVENTS, Block, CameraFrames, Choices, RecordingError, Source, sensor_size

MAGIC = b"\x89HDF\r\n\x1a\n"
DSEC_COLUMNS = ("events/t", "events/x", "events/y", "events/p")
ESFP_COLUMNS = ("t", "x", "y", "p")
METAVISION = "CD/events"
TRIGGERS = "triggers"  # times of a trigger signal in microseconds
MAX_WHOLE = 2**53  # largest whole number that a float holds exactly
E2P_COLUMNS = 4  # columns of /events: t in microseconds, x, y, p of 0 or 1
E2P_FRAMES, E2P_MAPS = ("frame_ts", "frame"), ("intensity", "dolp", "aolp")
E2P_WHITE = 255.0  # level in its maps of saturated light, of DoLP 1 and of AoLP 90 degrees; level 0 is AoLP -90 degrees

Description = dict[str, Any]

_library = IsolatedLibrary(
    "HDF5",
    "h5py",
    "hdf5",
    Path(__file__).with_name("hdf5_tasks.py"),
    "the file is damaged, or compressed with a filter that is not installed: pip install hdf5plugin; for Prophesee's "
    "ECF install the HDF5 plugin of Metavision or OpenEB and name its folder in HDF5_PLUGIN_PATH",
)


def matching(*tables: str) -> Callable[[Path, bytes], bool]:
    """A check of whether a file is HDF5 with these tables."""

    def matches(path: Path, head: bytes) -> bool:
        if not head.startswith(MAGIC):
            return False
        try:
            return set(tables) <= set(_described(path)["tables"])
        except (RecordingError, RuntimeError):
            return False  # `open_dsec` reports the reason

    return matches


matches_e2p, matches_esfp, matches_metavision = matching("events"), matching(*ESFP_COLUMNS), matching(METAVISION)


def matches_dsec(path: Path, head: bytes) -> bool:
    """Whether it is an HDF5 file, whatever its content."""
    return head.startswith(MAGIC)


def open_dsec(path: Path, choices: Choices) -> Source:
    """Open columns events/{t,x,y,p} (Gehrig et al. 2021), at times t + t_offset; p is 1 or 0.

    DSEC does not state the size of its sensors, 480 x 640; files that polarnet writes do.
    """
    return _open_columns(path, choices, DSEC_COLUMNS, "DSEC's")


def open_esfp(path: Path, choices: Choices) -> Source:
    """Open the columns t, x, y, p of ESfP (Muglikar et al. 2023), in microseconds and p of 1 or 0."""
    return _open_columns(path, choices, ESFP_COLUMNS, "ESfP's")


def trigger_times_us(path: Path) -> np.ndarray:
    """Times in the table /triggers; RecordingError if there is none."""
    description = _described(path)
    if TRIGGERS not in description["tables"]:
        raise RecordingError(f"{path.name}: expected a table /{TRIGGERS} of times in microseconds, there is none")
    length = _length(path, description, TRIGGERS, 1)
    blocks = [_microseconds(path, t) for (t,) in _read(path, (TRIGGERS,), length)]
    return np.concatenate(blocks) if blocks else np.empty(0, np.int64)


def _open_columns(path: Path, choices: Choices, columns: tuple[str, ...], layout: str) -> Source:
    description = _described(path)
    absent = [name for name in columns if name not in description["tables"]]
    if absent:
        raise RecordingError(f"{path.name}: expected {layout} HDF5, there is no {', '.join(absent)}")
    lengths = [_length(path, description, name, 1) for name in columns]
    if len(set(lengths)) > 1:
        raise RecordingError(f"{path.name}: its columns t, x, y, p have different lengths, {lengths}")
    offset_us = _whole(path, description, "t_offset") or 0
    height, width = (_whole(path, description, name) for name in ("height", "width"))

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        for t, x, y, p in _read(path, columns, lengths[0]):
            yield Block(_microseconds(path, t) + offset_us, x, y, p)

    return Source(*sensor_size(path, choices, height, width), blocks)


def open_e2p(path: Path, choices: Choices) -> Source:
    """Open the table /events of E2P (Mei et al. 2023): rows t, x, y, p.

    The attribute sensor_resolution is width, height. The pixels lie behind polarizers, rows 90 45 / 135 0 degrees from
    the upper left; the events cover all four angles.
    """
    description = _described(path)
    if "events" not in description["tables"]:
        raise RecordingError(f"{path.name}: expected E2P's HDF5, there is no table /events")
    length = _length(path, description, "events", 2)
    columns = description["tables"]["events"][0][1]
    if columns != E2P_COLUMNS:
        raise RecordingError(f"{path.name}: expected the four columns t, x, y, p of /events, got {columns}")
    size = description["values"].get("sensor_resolution")
    if size is not None and not (isinstance(size, list) and len(size) == 2):
        raise RecordingError(f"{path.name}: expected width and height as sensor_resolution, got {size}")
    height = width = None
    if size is not None:
        width, height = (_number(path, "sensor_resolution", side) for side in size)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        for (table,) in _read(path, ("events",), length):
            t, x, y, p = np.ascontiguousarray(table.T)
            yield Block(_microseconds(path, t), x, y, p)

    return Source(*sensor_size(path, choices, height, width), blocks)


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
    blocks = [*_read(path, tuple(names), lengths["frame_ts"])]
    values = {name: np.concatenate([block[k] for block in blocks]) for k, name in enumerate(names)} if blocks else {}
    if not values:
        raise RecordingError(f"{path.name}: expected frames as true polarization, there are 0")
    maps = None
    if set(E2P_MAPS) <= set(names):
        s0, dolp, aolp = (values[name] / np.float32(E2P_WHITE) for name in E2P_MAPS)
        maps = s0, dolp, np.remainder(np.pi * (aolp - 0.5), np.pi).astype(np.float32)
    return CameraFrames(_microseconds(path, values["frame_ts"]), values.get("frame"), maps)


def open_metavision(path: Path, choices: Choices) -> Source:
    """Open the table CD/events of Prophesee: records of x, y, p of 1 or 0, and t in microseconds.

    The attribute geometry is "WIDTHxHEIGHT". Its own compression, ECF, needs Prophesee's HDF5 plugin.
    """
    description = _described(path)
    if METAVISION not in description["tables"]:
        raise RecordingError(
            f"{path.name}: expected a table {METAVISION}, got {', '.join(description['tables']) or 'none'}"
        )
    (length, *_), kind = description["tables"][METAVISION]
    if kind != "V":
        raise RecordingError(f"{path.name}: expected records of x, y, p, t in {METAVISION}, got type {kind!r}")
    stated = re.fullmatch(r"(\d{1,5})x(\d{1,5})", str(description["values"].get("geometry")))
    width, height = map(int, stated.groups()) if stated else (None, None)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        for (table,) in _read(path, (METAVISION,), length):
            if missing := set("txyp") - set(table.dtype.names or ()):
                raise RecordingError(f"{path.name}: expected x, y, p, t in {METAVISION}, there is no {min(missing)}")
            yield Block(_microseconds(path, table["t"]), table["x"], table["y"], table["p"])

    return Source(*sensor_size(path, choices, height, width), blocks)


def _described(path: Path) -> Description:
    tables = [*DSEC_COLUMNS, *ESFP_COLUMNS, "events", TRIGGERS, METAVISION, *E2P_FRAMES, *E2P_MAPS]
    return _library.ask(path, "describe", tables, ["t_offset", "height", "width", "sensor_resolution", "geometry"])


def _read(path: Path, tables: tuple[str, ...], length: int) -> Iterator[list[np.ndarray]]:
    try:
        for start in range(0, length, BLOCK_EVENTS):
            yield _library.ask(path, "read", tables, start, start + BLOCK_EVENTS)
    finally:
        with contextlib.suppress(RecordingError, RuntimeError):
            _library.ask(path, "close")


def _length(path: Path, description: Description, name: str, dimensions: int) -> int:
    shape, kind = description["tables"][name]
    if len(shape) != dimensions:
        raise RecordingError(f"{path.name}: expected {name} as a table of {dimensions} dimensions, got {len(shape)}")
    if kind not in "iufb":
        raise RecordingError(f"{path.name}: expected numbers in {name}, got type {kind!r}")
    return shape[0]


def _whole(path: Path, description: Description, name: str) -> int | None:
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
