"""The process of `isolated.ask`: runs tasks with format libraries and sends their answers.

It imports nothing else of polarnet, so that it starts quickly. A task is a function of a path that yields answers.
Answers are JSON and the bytes of arrays, since a damaged file may have made the library's process send anything.
"""

import contextlib
import json
import os
import resource
import signal
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

GATHERED_EVENTS = 2**16  # per answer; the packets and messages of a file are small
END_OF_FILE = "failed to fill whole buffer"  # faery's message where a packet is longer than what is left of the file


def serve(pipe: Connection, max_mib: int) -> None:
    """Answer requests, a task and its arguments, until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the main process, which then ends this one
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what libraries print about damage; the error is sent
    with contextlib.suppress(ValueError):  # above a limit that the process has already
        resource.setrlimit(resource.RLIMIT_AS, (max_mib * 2**20, resource.getrlimit(resource.RLIMIT_AS)[1]))
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            task, *arguments = pipe.recv()
            end = "end", ""
            try:
                for answer in task(*arguments):
                    _send(pipe, "answer", answer)
            except BrokenPipeError:
                raise
            except BaseException as error:  # HDF5 raises many kinds, and a panic in Rust code is not an Exception
                end = "error", f"{type(error).__name__}: {error}"[:500]
            _send(pipe, *end)


def _send(pipe: Connection, kind: str, answer: Any) -> None:
    """Send a line of JSON, in which each array is its type and shape, and then the bytes of the arrays."""
    arrays: list[np.ndarray] = []

    def described(value: np.ndarray) -> dict[str, Any]:
        arrays.append(np.ascontiguousarray(value))
        return {"dtype": value.dtype.str, "shape": value.shape}

    pipe.send_bytes(json.dumps([kind, answer], default=described).encode())
    for array in arrays:
        pipe.send_bytes(array.tobytes())


def received(pipe: Connection) -> tuple[str, Any]:
    """What `_send` sent; tuples have become lists."""

    def whole(value: dict[str, Any]) -> Any:
        if value.keys() != {"dtype", "shape"}:
            return value
        return np.frombuffer(pipe.recv_bytes(), value["dtype"]).reshape(value["shape"]).copy()

    kind, answer = json.loads(pipe.recv_bytes(), object_hook=whole)
    return kind, answer


def gathered(pieces: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """The pieces, joined to tables of at least `GATHERED_EVENTS` events; the last may be shorter."""
    batch: list[np.ndarray] = []
    for piece in pieces:
        batch.append(piece)
        if sum(map(len, batch)) >= GATHERED_EVENTS:
            yield np.concatenate(batch)
            batch = []
    if batch:
        yield np.concatenate(batch)


def hdf5_description(path: str, tables: Sequence[str], attributes: Sequence[str]) -> Iterator[tuple[dict, dict]]:
    """Shape, number kind and field names of each existing table, and values of existing scalars and attributes."""
    shapes, values = {}, {}
    with _hdf5(path) as (file, dataset):
        for key in tables:
            if isinstance(table := file.get(key), dataset) and table.shape is not None:
                shapes[key] = (table.shape, table.dtype.kind, table.dtype.names or ())
        for key in attributes:
            if key in file.attrs:
                values[key] = _plain(np.asarray(file.attrs[key]))
            elif isinstance(scalar := file.get(key), dataset) and scalar.shape in ((), (1,), (2,)):
                values[key] = _plain(np.asarray(scalar[()]))
    yield shapes, values


def hdf5_columns(
    path: str, columns: Sequence[tuple[str, str | int | None]], block_rows: int
) -> Iterator[list[np.ndarray]]:
    """Columns in blocks of rows: of each table the whole, a field of its records, or a column by number."""
    with _hdf5(path) as (file, _):
        for start in range(0, len(file[columns[0][0]]), block_rows):
            rows = {name: file[name][start : start + block_rows] for name in dict(columns)}
            yield [
                rows[name] if part is None else rows[name][part if isinstance(part, str) else (slice(None), part)]
                for name, part in columns
            ]


@contextlib.contextmanager
def _hdf5(path: str) -> Iterator[Any]:
    """An open file, and the class of its tables."""
    import h5py

    with contextlib.suppress(ImportError):
        import hdf5plugin  # noqa: F401  # the compression of DSEC's own files
    with h5py.File(path, "r") as file:
        yield file, h5py.Dataset


def _plain(value: np.ndarray) -> Any:
    """Python numbers for short numeric arrays, text for anything else."""
    if value.dtype.kind in "iuf" and value.size <= 8:
        return value.tolist() if value.size != 1 else value.item()
    value = value.item() if value.size == 1 else value
    return (value.decode("ascii", "replace") if isinstance(value, bytes) else str(value))[:80]


def faery_streams(path: str, aedat4: bool) -> Iterator[dict[str, tuple[int, int]]]:
    """Height and width of each stream of events of AEDAT4, or of the one of Event Stream."""
    import faery

    if aedat4:
        tracks = [track for track in faery.aedat.Decoder(path).tracks() if track.data_type == "events"]
        yield {str(track.id): (track.dimensions[1], track.dimensions[0]) for track in tracks}
    else:
        yield {"": faery.events_stream_from_file(path, file_type="es").dimensions()[::-1]}


def faery_events(path: str, stream: str) -> Iterator[list[np.ndarray] | None]:
    """Columns t, x, y and polarity (1 or 0) of the events of a stream; None at last if the file is cut."""
    import faery

    cut: list[str] = []
    packets = (packet for track, packet in _aedat4_packets(path, cut) if str(track.id) == stream)
    for table in gathered(packets if stream else iter(faery.events_stream_from_file(path, file_type="es"))):
        yield [table["t"], table["x"], table["y"], table["on"].astype(np.uint8)]
    if cut:
        yield None


def aedat4_frames(path: str) -> Iterator[tuple[np.ndarray, np.ndarray] | None]:
    """Times and grey levels of all frames; None if there are none, or if they differ in size."""
    times, levels = [], []
    for track, packet in _aedat4_packets(path, []):
        if track.data_type == "frame" and packet.pixels.ndim == 2:
            start, end = packet.exposure_start_t, packet.exposure_end_t
            times.append((start + end) // 2 if 0 < start < end else packet.t)
            levels.append(packet.pixels)
    yield (np.array(times), np.stack(levels)) if len({one.shape for one in levels}) == 1 else None


def _aedat4_packets(path: str, cut: list[str]) -> Iterator[tuple[Any, Any]]:
    """Streams and packets up to the end of the file, or to the place where it is cut, which is noted in `cut`."""
    import faery

    try:
        yield from faery.aedat.Decoder(path)
    except RuntimeError as error:
        if END_OF_FILE not in str(error):
            raise
        cut.append(str(error))
