"""Run format libraries in separate processes, so that a crash on a damaged file does not end the main process."""

import contextlib
import importlib.util
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from polarnet.recordings.formats.isolated_worker import received, serve
from polarnet.recordings.source import RecordingError
from polarnet.terminal.installation import installation

PATIENCE_S = 60  # limit for an answer; a damaged file can put a library into an endless loop
MAX_MIB = 8192  # address space of a process; a damaged file can state any size

SPAWN = multiprocessing.get_context("spawn")  # a forked process would hold torch's threads and memory


class Library(NamedTuple):
    """A library that reads files."""

    name: str
    package: str
    """Package that its tasks import."""
    advice: str
    """End of the message about an unreadable file."""


class _Worker(NamedTuple):
    process: SpawnProcess
    pipe: Connection

    def end(self) -> None:
        self.process.terminate()
        self.process.join()
        self.pipe.close()


_idle: list[_Worker] = []
os.register_at_fork(after_in_child=_idle.clear)  # a forked process must not share its parent's workers


def ask(library: Library, path: Path, task: Callable[..., Iterable[Any]], *arguments: Any) -> Iterator[Any]:
    """The answers of a task about a file; RecordingError with the library's message, or if it crashed or took too long.

    A process answers one task at a time; it starts on first use and serves later tasks, whichever their library. It
    imports the task's module. RuntimeError names the package to install where the library is missing.
    """
    if sys.modules.get(library.package, True) is None or importlib.util.find_spec(library.package) is None:
        raise RuntimeError(f"{path.name}: this format needs {library.package}: {installation('recordings')}")
    worker, kind = _ready_worker(), "answer"
    try:
        with contextlib.suppress(OSError):  # a process that has ended has no answer either
            worker.pipe.send((task, str(path.absolute()), *arguments))
        while kind != "end":
            kind, answer = _received(worker.pipe)
            if kind in ("error", "crash"):
                advice = library.advice if kind == "error" else "the file is damaged"
                raise RecordingError(f"{path.name}: {library.name} cannot read it: {answer}; {advice}")
            if kind == "answer":
                yield answer
    finally:
        if kind in ("end", "error"):
            _idle.append(worker)
        else:
            worker.end()


def ask_once(library: Library, path: Path, task: Callable[..., Iterable[Any]], *arguments: Any) -> Any:
    """The one answer of a task, with the errors of `ask`."""
    (answer,) = ask(library, path, task, *arguments)
    return answer


def _received(pipe: Connection) -> tuple[str, Any]:
    """`answer` and the next one, `error` and its message, or `end`; `crash` if the process gives no sound answer."""
    with contextlib.suppress(Exception):  # half an answer fails in any way
        if pipe.poll(PATIENCE_S):
            return received(pipe)
    return "crash", f"the library crashed or took over {PATIENCE_S} s"


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
