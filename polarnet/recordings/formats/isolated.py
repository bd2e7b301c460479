"""Run format libraries in separate processes, so that a crash on a damaged file does not end the main process."""

import contextlib
import importlib.util
import json
import multiprocessing
import os
import sys
from collections.abc import Iterator
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from polarnet.recordings.formats.isolated_worker import serve
from polarnet.recordings.source import RecordingError
from polarnet.terminal.installation import installation

PATIENCE_S = 60  # limit for an answer; a damaged file can put a library into an endless loop
MAX_MIB = 8192  # address space of a process; a damaged file can state any size

SPAWN = multiprocessing.get_context("spawn")  # a forked process would hold torch's threads and memory


class Library(NamedTuple):
    """A library that reads files, and the module of its tasks (see `isolated_worker`)."""

    name: str
    package: str
    """Package that the tasks import."""
    extra: str
    """polarnet's extra that installs the package."""
    tasks: str
    advice: str
    """End of the message about an unreadable file."""


class Answer(NamedTuple):
    """One answer of a task."""

    value: Any
    """Numbers, text, lists and dictionaries."""
    arrays: list[np.ndarray]


class _Worker(NamedTuple):
    process: SpawnProcess
    pipe: Connection

    def end(self) -> None:
        self.process.terminate()
        self.process.join()
        self.pipe.close()


_idle: list[_Worker] = []
os.register_at_fork(after_in_child=_idle.clear)  # a forked process must not share its parent's workers


def ask(library: Library, path: Path, task: str, *arguments: Any) -> Iterator[Answer]:
    """The answers of a task about a file; RecordingError with the library's message, or if it crashed or took too long.

    A process answers one task at a time; it starts on first use and serves later tasks, whichever their library.
    RuntimeError names the package to install where the library is missing.
    """
    if sys.modules.get(library.package, True) is None or importlib.util.find_spec(library.package) is None:
        raise RuntimeError(f"{path.name}: this format needs {library.package}: {installation(library.extra)}")
    worker, done = _ready_worker(), False
    try:
        with contextlib.suppress(OSError):  # a process that has ended has no answer either
            worker.pipe.send_bytes(json.dumps([library.tasks, task, str(path.absolute()), *arguments]).encode())
        while not done:
            answer = _received(worker.pipe)
            if answer is None:
                raise RecordingError(
                    f"{path.name}: {library.name} cannot read it: the library crashed or took over {PATIENCE_S} s; "
                    f"the file is damaged"
                )
            done = not isinstance(answer, Answer)
            if isinstance(answer, str):
                raise RecordingError(f"{path.name}: {library.name} cannot read it: {answer}; {library.advice}")
            if isinstance(answer, Answer):
                yield answer
    finally:
        if done:
            _idle.append(worker)
        else:
            worker.end()


def ask_once(library: Library, path: Path, task: str, *arguments: Any) -> Answer:
    """The one answer of a task, with the errors of `ask`."""
    (answer,) = ask(library, path, task, *arguments)
    return answer


def _received(pipe: Connection) -> "Answer | str | bool | None":
    """The next answer, the error that ends the task, True at its end; None if the process gives no sound answer."""
    try:
        if not pipe.poll(PATIENCE_S):
            return None
        head = json.loads(pipe.recv_bytes())
        if "end" in head:
            return head.get("error", True)
        arrays = [
            np.frombuffer(pipe.recv_bytes(), np.dtype(kind)).reshape(shape).copy() for kind, shape in head["arrays"]
        ]
        return Answer(head["value"], arrays)
    except (EOFError, OSError, ValueError, KeyError, TypeError):
        return None


def _ready_worker() -> _Worker:
    while _idle:
        worker = _idle.pop()
        if worker.process.is_alive():
            return worker
        worker.end()
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.Process(target=serve, args=(theirs, MAX_MIB), daemon=True)
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")  # the process would run the user's script again
    try:
        process.start()
    finally:
        sys.modules["__main__"] = main
    theirs.close()
    return _Worker(process, ours)
