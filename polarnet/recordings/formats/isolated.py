"""Run format libraries in separate processes, so that a crash on a damaged file does not end the main process."""

import atexit
import contextlib
import importlib.util
import itertools
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from polarnet.recordings.source import RecordingError
from polarnet.terminal.installation import installation

PATIENCE_S = 60  # limit for an answer; a damaged file can put a library into an endless loop
MAX_MIB = 8192  # address space of the process; a damaged file can state any size
WORKER = Path(__file__).with_name("isolated_worker.py")

_readers = itertools.count()


class IsolatedLibrary:
    """A library and its process, which starts on first use and again after a crash.

    The process answers the TASKS of the file `tasks`, one request at a time. `package` is the package they import, and
    `extra` is polarnet's extra that installs it. `advice` ends the message about an unreadable file.
    """

    def __init__(self, name: str, package: str, extra: str, tasks: Path, advice: str):
        self._name = name
        self._package = package
        self._extra = extra
        self._tasks = tasks
        self._advice = advice
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = 0
        self._lock = threading.Lock()

    def ask(self, path: Path, task: str, *arguments: Any) -> Any:
        """The answer to a task; RecordingError with the library's message, or if it crashed or took too long.

        RuntimeError names the package to install where the library is missing.
        """
        if sys.modules.get(self._package, True) is None or importlib.util.find_spec(self._package) is None:
            raise RuntimeError(f"{path.name}: this format needs {self._package}: {installation(self._extra)}")
        with self._lock:
            process = self._running()
            assert process.stdin is not None
            assert process.stdout is not None
            deadline = threading.Timer(PATIENCE_S, process.kill)
            deadline.start()
            try:
                pickle.dump((task, str(path.absolute()), *arguments), process.stdin)
                process.stdin.flush()
                kind, answer = pickle.load(process.stdout)
            except (EOFError, BrokenPipeError, pickle.UnpicklingError):
                self._stop(process)
                raise RecordingError(
                    f"{path.name}: {self._name} cannot read it: the library crashed or took over {PATIENCE_S} s; the "
                    f"file is damaged"
                ) from None
            except BaseException:  # interrupted before the answer, which must not reach the next request
                self._stop(process)
                raise
            finally:
                deadline.cancel()
        if kind == "error":
            raise RecordingError(f"{path.name}: {self._name} cannot read it: {answer}; {self._advice}")
        return answer

    def blocks(self, path: Path, *arguments: Any) -> Iterator[np.ndarray]:
        """The tables that the task `pieces` yields, joined to blocks."""
        reader, numbers = next(_readers), itertools.count()
        try:
            while (table := self.ask(path, "block", reader, next(numbers), *arguments)) is not None:
                yield table
        finally:
            with contextlib.suppress(RecordingError, RuntimeError):
                self.ask(path, "release", reader)

    def _running(self) -> "subprocess.Popen[bytes]":
        if self._owner != os.getpid() or self._process is None or self._process.poll() is not None:
            self._owner = os.getpid()  # a forked process must not share its parent's worker
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(WORKER), str(self._tasks), str(MAX_MIB)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
            atexit.unregister(self._end)
            atexit.register(self._end)
        return self._process

    def _end(self) -> None:
        """Stop this process's own worker."""
        if self._process is not None and self._owner == os.getpid():
            self._stop(self._process)

    def _stop(self, process: "subprocess.Popen[bytes]") -> None:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        self._process = None
