"""HDF5 files of two kinds: events as DSEC stores them, and the recordings of a polarization camera of E2P (PDAVIS)."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from polarnet.recordings.source import BLOCK_EVENTS, Block, Choices, RecordingError, Source, sensor_size

MAGIC = b"\x89HDF\r\n\x1a\n"
DSEC_COLUMNS = ("events/t", "events/x", "events/y", "events/p")
LARGEST = 2**53  # whole number
E2P_COLUMNS = 4  # of /events: t in microseconds, x, y, p of 0 or 1


def matches_e2p(path: Path, head: bytes) -> bool:
    """Whether the file has one table of events."""
    if not head.startswith(MAGIC):
        return False
    try:
        with _opened(path) as file:
            return hasattr(file["events"], "shape")
    except (RecordingError, RuntimeError):
        return False  # `open_dsec` says why


def matches_dsec(path: Path, head: bytes) -> bool:
    """Whether it is an HDF5 file, of whatever else."""
    return head.startswith(MAGIC)


def open_dsec(path: Path, choices: Choices) -> Source:
    """Columns events/{t,x,y,p} (Gehrig et al. 2021), at times t + t_offset; p is 1 or 0.

    DSEC itself does not state the size of its sensors, 480 x 640; files that polarnet writes do.
    """
    with _opened(path) as file:
        absent = [name for name in DSEC_COLUMNS if name not in file]
        if absent:
            raise RecordingError(f"{path.name}: expected DSEC's HDF5, there is no {', '.join(absent)}")
        lengths = [_length(path, file[name], 1) for name in DSEC_COLUMNS]
        if len(set(lengths)) > 1:
            raise RecordingError(f"{path.name}: its columns t, x, y, p have different lengths, {lengths}")
        offset_us = _whole(path, "t_offset", file["t_offset"][()]) if "t_offset" in file else 0
        height, width = (_attribute(path, file, name) for name in ("height", "width"))

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        with _opened(path) as file:
            columns = [file[name] for name in DSEC_COLUMNS]
            for start in range(0, lengths[0], BLOCK_EVENTS):
                t, x, y, p = (column[start : start + BLOCK_EVENTS] for column in columns)
                yield Block(_microseconds(path, t) + offset_us, x, y, p)

    return Source(*sensor_size(path, choices, height, width), blocks)


def open_e2p(path: Path, choices: Choices) -> Source:
    """The table /events of E2P (Mei et al. 2023): rows t, x, y, p; the attribute sensor_resolution is width, height.

    The pixels lie behind polarizers, rows 90 45 / 135 0 degrees from the upper left; the events are those of all.
    """
    with _opened(path) as file:
        if "events" not in file or not hasattr(file["events"], "shape"):
            raise RecordingError(f"{path.name}: expected E2P's HDF5, there is no table /events")
        length = _length(path, file["events"], 2)
        if file["events"].shape[1] != E2P_COLUMNS:
            raise RecordingError(
                f"{path.name}: expected the four columns t, x, y, p of /events, got {file['events'].shape[1]}"
            )
        height = width = None
        if "sensor_resolution" in file.attrs:
            size = np.ravel(file.attrs["sensor_resolution"])
            if size.shape != (2,):
                raise RecordingError(f"{path.name}: expected width and height as sensor_resolution, got {size}")
            width, height = (_whole(path, "sensor_resolution", side) for side in size)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        with _opened(path) as file:
            for start in range(0, length, BLOCK_EVENTS):
                t, x, y, p = np.ascontiguousarray(file["events"][start : start + BLOCK_EVENTS].T)
                yield Block(_microseconds(path, t), x, y, p)

    return Source(*sensor_size(path, choices, height, width), blocks)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """An HDF5 file; whatever the library says about a damaged one becomes a RecordingError."""
    try:
        import h5py
    except ImportError:
        raise RuntimeError(f"{path.name}: HDF5 needs h5py: pip install 'polarnet[hdf5]'") from None
    with suppress(ImportError):
        import hdf5plugin  # noqa: F401  # the compression of DSEC's own files
    try:
        with h5py.File(path, "r") as file:
            yield file
    except RecordingError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError, AttributeError) as error:
        raise RecordingError(
            f"{path.name}: HDF5 cannot read it: {error}; it is damaged, or compressed in a way that needs "
            f"pip install 'polarnet[recordings]'"
        ) from error


def _length(path: Path, table: Any, dimensions: int) -> int:
    if not hasattr(table, "shape") or table.shape is None or len(table.shape) != dimensions:
        raise RecordingError(f"{path.name}: expected {table.name} as a table of {dimensions} dimensions")
    if table.dtype.kind not in "iufb":
        raise RecordingError(f"{path.name}: expected numbers in {table.name}, got {table.dtype}")
    return int(table.shape[0])


def _attribute(path: Path, file: Any, name: str) -> int | None:
    return _whole(path, name, file.attrs[name]) if name in file.attrs else None


def _whole(path: Path, name: str, value: Any) -> int:
    value = np.asarray(value)
    if (
        value.shape != ()
        or value.dtype.kind not in "iuf"
        or not np.isfinite(value)
        or int(value) != value
        or abs(int(value)) > LARGEST
    ):
        raise RecordingError(f"{path.name}: expected a whole number as {name}, got {value}")
    return int(value)


def _microseconds(path: Path, t: np.ndarray) -> np.ndarray:
    if t.dtype.kind == "f" and not (np.equal(t, np.floor(t)).all() and (np.abs(t) < 2.0**53).all()):
        raise RecordingError(f"{path.name}: expected whole microseconds as times")
    return t.astype(np.int64)
