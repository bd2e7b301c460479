"""The process of `isolated.ask`: runs the tasks of format libraries and sends their answers as raw bytes.

It imports nothing else of polarnet, so that it starts quickly. A task is a function in the dictionary TASKS of a
module. It yields answers: a value for JSON and a list of arrays.
"""

import contextlib
import importlib
import json
import os
import signal
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

GATHERED_EVENTS = 2**16  # per answer; the packets and messages of a file are small

Answer = tuple[Any, Sequence[np.ndarray]]


def serve(pipe: Connection, max_mib: int) -> None:
    """Answer requests, a JSON list of module, task and arguments, until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the main process, which then ends this one
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what libraries print about damage; the error is sent
    _limit_memory(max_mib)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            module, task, *arguments = json.loads(pipe.recv_bytes())
            end: dict[str, Any] = {"end": True}
            try:
                for value, arrays in importlib.import_module(module).TASKS[task](*arguments):
                    _send(pipe, value, arrays)
            except BrokenPipeError:
                raise
            except BaseException as error:  # HDF5 raises many kinds, and a panic in Rust code is not an Exception
                end["error"] = f"{type(error).__name__}: {error}"[:500]
            pipe.send_bytes(json.dumps(end).encode())


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


def _send(pipe: Connection, value: Any, arrays: Sequence[np.ndarray]) -> None:
    """Send the value with the types and shapes of the arrays as JSON, and then the bytes of each array."""
    kinds = [(array.dtype.str, array.shape) for array in arrays]
    pipe.send_bytes(json.dumps({"value": value, "arrays": kinds}).encode())
    for array in arrays:
        pipe.send_bytes(array.tobytes())


def _limit_memory(mib: int) -> None:
    """Make allocations beyond the limit fail, where the system supports it."""
    with contextlib.suppress(ImportError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (mib * 2**20, resource.getrlimit(resource.RLIMIT_AS)[1]))
