"""The process of an `IsolatedLibrary`: answers requests with the TASKS of the file given at its start.

Requests arrive pickled on standard input, and pickled answers go to standard output. It imports nothing of polarnet, so
that it starts quickly. A task `pieces`, which yields small tables, is answered in blocks by `block` and `release`.
"""

import contextlib
import functools
import pickle
import runpy
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

GATHERED_EVENTS = 2**16  # per answer; the packets and messages of a file are small

streams: dict[int, tuple[int, Iterator[np.ndarray]]] = {}
"""Open files by reader number: the number of blocks returned so far, and the remaining pieces."""


def block(
    pieces: Callable[..., Iterator[np.ndarray]], path: str, reader: int, number: int, *arguments: Any
) -> np.ndarray | None:
    """A reader's next block of joined pieces; None after the last.

    `number` counts the blocks already returned. If the process crashed on another file in between, they are read again.
    """
    done, rest = streams.get(reader, (-1, iter(())))
    if done != number:
        rest = iter(pieces(path, *arguments))
        for _ in range(number):
            gathered(rest)
    batch = gathered(rest)
    streams[reader] = number + 1, rest
    return np.concatenate(batch) if batch else None


def gathered(pieces: Iterator[np.ndarray]) -> list[np.ndarray]:
    """The next pieces, at least `GATHERED_EVENTS` events together; fewer before the end, none at the end."""
    batch, count = [], 0
    while count < GATHERED_EVENTS and (piece := next(pieces, None)) is not None:
        batch.append(piece)
        count += len(piece)
    return batch


def release(path: str, reader: int) -> None:
    """Forget a reader and its file."""
    streams.pop(reader, None)


def serve(tasks: dict[str, Any]) -> None:
    """Answer requests until the input ends."""
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    if "pieces" in tasks:
        tasks = {**tasks, "release": release, "block": functools.partial(block, tasks["pieces"])}
    reply: tuple[str, Any]
    while True:
        try:
            task, *arguments = pickle.load(requests)
        except EOFError:
            return
        try:
            reply = ("answer", tasks[task](*arguments))
        except BaseException as error:  # HDF5 raises many kinds, and a panic in Rust code is not an Exception
            reply = ("error", f"{type(error).__name__}: {error}"[:500])
        pickle.dump(reply, answers, protocol=5)
        answers.flush()


def limit_memory(mib: int) -> None:
    """Make allocations beyond the limit fail, where the system supports it."""
    with contextlib.suppress(ImportError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (mib * 2**20, resource.getrlimit(resource.RLIMIT_AS)[1]))


if __name__ == "__main__":
    limit_memory(int(sys.argv[2]))
    serve(runpy.run_path(sys.argv[1])["TASKS"])
