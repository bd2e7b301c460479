"""HDF5 files in the layouts of `LAYOUTS`: where their columns t (microseconds, or seconds), x, y and p are."""

import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from polarnet.recordings.formats import isolated_worker
from polarnet.recordings.formats.isolated import Library, ask, ask_once
from polarnet.recordings.source import BLOCK_EVENTS, Block, CameraFrames, Choices, Counts, RecordingError, Source

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
    "the file is damaged, or compressed with a filter that is not installed: pip install hdf5plugin; for Prophesee's "
    "ECF install the HDF5 plugin of Metavision or OpenEB and name its folder in HDF5_PLUGIN_PATH",
)

Column = tuple[str, str | int | None]
"""A table, and the field of its records or the number of its column; None for a table of one column."""


class Layout(NamedTuple):
    """Where the columns t, x, y, p of a file are."""

    owner: str
    columns: Sequence[Column]
    seconds: bool = False
    """Whether times with a fraction are seconds."""
    parts: Sequence[str] = ("",)
    """Cameras of one file, whose names stand for {} in the tables."""
    resolution: str = ""
    """Table with the sensor's width and height."""

    def of(self, part: str) -> list[Column]:
        """The columns of a camera."""
        return [(table.format(part), field) for table, field in self.columns]


LAYOUTS = {
    "e2p": Layout("E2P, for the PDAVIS, and of v2e", [("events", number) for number in range(4)]),
    "esfp": Layout("ESfP, one sensor behind a rotating polarizer", [(name, None) for name in "txyp"]),
    "metavision": Layout("Prophesee", [("CD/events", name) for name in "txyp"]),
    "monash": Layout("Monash, E2VID and EVREAL", [(f"events/{name}s", None) for name in "txyp"], seconds=True),
    "m3ed": Layout(
        "M3ED",
        [(f"prophesee/{{}}/{name}", None) for name in "txyp"],
        parts=("left", "right"),
        resolution="prophesee/{}/calib/resolution",
    ),
    "mvsec": Layout("MVSEC", [("davis/{}/events", k) for k in (2, 0, 1, 3)], seconds=True, parts=("left", "right")),
    "dsec": Layout("DSEC", [(f"events/{name}", None) for name in "txyp"]),
}
"""E2P: Mei et al. 2023, a sensor behind polarizers 90 45 / 135 0; v2e writes the same table. ESfP: Muglikar et al.
2023. Prophesee: Metavision, whose compression ECF needs Prophesee's HDF5 plugin. Monash: Stoffregen et al. 2020, also
of E2VID and EVREAL. M3ED: Chaney et al. 2023. MVSEC: Zhu et al. 2018. DSEC: Gehrig et al. 2021. The last two do not
state 260 x 346 and 480 x 640."""


def matches(layout: Layout, path: Path, head: bytes) -> bool:
    """Whether a file is HDF5 with the tables of a layout; for DSEC's, the last one tried, any HDF5."""
    if not head.startswith(MAGIC) or layout is LAYOUTS["dsec"]:
        return head.startswith(MAGIC)
    try:
        return bool(_parts(layout, _described(path)[0]))
    except (RecordingError, RuntimeError):
        return False  # `open_hdf5` reports the reason for DSEC's layout


def open_hdf5(layout: Layout, path: Path, choices: Choices) -> Source:
    """Open the events of a file of a layout."""
    tables, settings = _described(path)
    parts = _parts(layout, tables)
    if not parts:
        absent = ", ".join(table for table in dict(layout.of(layout.parts[0])) if table not in tables)
        raise RecordingError(f"{path.name}: expected HDF5 of {layout.owner}: there is no {absent}")
    part = parts[0] if parts == [""] else choices.part_of(path.name, parts, "camera")
    columns = layout.of(part)
    lengths = [_length(path, tables, *column) for column in columns]
    if len(set(lengths)) > 1:
        raise RecordingError(f"{path.name}: its columns t, x, y, p have different lengths, {lengths}")
    offset_us = _whole(path, "t_offset", settings.get("t_offset")) or 0

    def blocks(counts: Counts) -> Iterator[Block]:
        seconds: bool | None = None
        for number, (t, x, y, p) in enumerate(_read(path, columns)):
            counts.share_read = min(1.0, number * BLOCK_EVENTS / lengths[0])
            if seconds is None:
                seconds = layout.seconds and t.dtype.kind == "f" and not np.equal(t, np.floor(t)).all()
            t = np.rint(t * 1e6) if seconds else t
            yield Block(_microseconds(path, t) + offset_us, x, y, p)

    return Source(*_stated_size(path, settings, settings.get(layout.resolution.format(part))), blocks)


def _parts(layout: Layout, tables: Collection[str]) -> list[str]:
    """The cameras whose tables are all there."""
    return [part for part in layout.parts if dict(layout.of(part)).keys() <= set(tables)]


def trigger_times_us(path: Path) -> np.ndarray:
    """Times in the table /triggers; RecordingError if there is none."""
    tables, _ = _described(path)
    if TRIGGERS not in tables:
        raise RecordingError(f"{path.name}: expected a table /{TRIGGERS} of times in microseconds, there is none")
    _length(path, tables, TRIGGERS, None)
    blocks = [_microseconds(path, t) for (t,) in _read(path, [(TRIGGERS, None)])]
    return np.concatenate([np.empty(0, np.int64), *blocks])


def e2p_frames(path: Path) -> CameraFrames:
    """Frames of E2P's HDF5: times /frame_ts, mosaics /frame, and maps /intensity, /dolp, /aolp of half the size."""
    tables, _ = _described(path)
    names = [name for name in (*E2P_FRAMES, *E2P_MAPS) if name in tables]
    has_maps = set(E2P_MAPS) <= set(names)
    if "frame_ts" not in names or not ("frame" in names or has_maps):
        raise RecordingError(
            f"{path.name}: expected /frame_ts, and /frame or {', '.join(f'/{name}' for name in E2P_MAPS)}, as true "
            f"polarization, got {', '.join(names) or 'none of them'}"
        )
    lengths = {name: tables[name][0][0] for name in names}
    if len(set(lengths.values())) > 1 or not lengths["frame_ts"]:
        raise RecordingError(f"{path.name}: expected one length of all tables of frames, at least 1, got {lengths}")
    blocks = zip(*_read(path, [(name, None) for name in names]), strict=True)
    values = {name: np.concatenate(parts) for name, parts in zip(names, blocks, strict=True)}
    maps = None
    if has_maps:
        s0, dolp, aolp = (values[name] / np.float32(E2P_WHITE) for name in E2P_MAPS)
        maps = s0, dolp, np.remainder(np.pi * (aolp - 0.5), np.pi).astype(np.float32)
    return CameraFrames(_microseconds(path, values["frame_ts"]), values.get("frame"), maps)


def _described(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Shape, number kind and fields of the tables of all layouts that the file has, and its `SETTINGS`."""
    layouts = [(layout, part) for layout in LAYOUTS.values() for part in layout.parts]
    names = [table for layout, part in layouts for table in dict(layout.of(part))]
    settings = [*SETTINGS, *(layout.resolution.format(part) for layout, part in layouts if layout.resolution)]
    names += [TRIGGERS, *E2P_FRAMES, *E2P_MAPS]
    shapes, values = ask_once(HDF5, path, isolated_worker.hdf5_description, names, settings)
    return {name: (tuple(shape), kind, fields) for name, (shape, kind, fields) in shapes.items()}, values


def _read(path: Path, columns: Sequence[Column]) -> Iterator[list[np.ndarray]]:
    return ask(HDF5, path, isolated_worker.hdf5_columns, columns, BLOCK_EVENTS)


def _length(path: Path, tables: dict[str, Any], name: str, part: str | int | None) -> int:
    """Number of rows; RecordingError if the table is not as the column needs it."""
    shape, kind, fields = tables[name]
    if isinstance(part, str) and part not in fields:
        raise RecordingError(f"{path.name}: expected records of x, y, p, t in {name}, there is no {part}")
    if len(shape) != (2 if isinstance(part, int) else 1) or shape[1:] not in ((), (4,)):
        raise RecordingError(f"{path.name}: expected {name} as a table of another shape, got {shape}")
    if not isinstance(part, str) and kind not in "iufb":
        raise RecordingError(f"{path.name}: expected numbers in {name}, got type {kind!r}")
    return shape[0]


def _stated_size(path: Path, settings: dict[str, Any], resolution: Any) -> tuple[int | None, int | None]:
    """Height and width as the file states them: two numbers, "WIDTHxHEIGHT", or a pair, whose larger is the width."""
    if geometry := re.fullmatch(r"(\d{1,5})x(\d{1,5})", str(settings.get("geometry"))):
        return int(geometry[2]), int(geometry[1])
    pair = settings.get("sensor_resolution", resolution)
    if pair is None:
        height, width = (_whole(path, "the sensor's size", settings.get(name)) for name in ("height", "width"))
        return height, width
    if not (isinstance(pair, list) and len(pair) == 2):
        raise RecordingError(f"{path.name}: expected width and height as sensor_resolution, got {pair}")
    height, width = sorted(side for one in pair if (side := _whole(path, "the sensor's size", one)) is not None)
    return height, width


def _whole(path: Path, name: str, value: Any) -> int | None:
    if value is None:
        return None
    if not isinstance(value, (int, float)) or not abs(value) <= MAX_WHOLE or int(value) != value:
        raise RecordingError(f"{path.name}: expected a whole number as {name}, got {value}")
    return int(value)


def _microseconds(path: Path, t: np.ndarray) -> np.ndarray:
    if t.dtype.kind == "f":
        exact = np.equal(t, np.floor(t)) & (np.abs(t) < 2.0 ** (np.finfo(t.dtype).nmant + 1))
        if not exact.all():
            raise RecordingError(f"{path.name}: expected whole microseconds as times, got {t[~exact][0]} as {t.dtype}")
    return t.astype(np.int64)
