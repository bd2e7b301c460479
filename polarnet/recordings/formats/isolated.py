"""Libraries that read a format in a process of their own: one that crashes on a damaged file must not end ours."""

import contextlib
import importlib.util
import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from polarnet.recordings.source import RecordingError

PATIENCE_S = 60  # for an answer; a damaged file can send a library round in circles
LARGEST_MIB = 8192  # that a process may address; a damaged file can state any size
WORKER = Path(__file__).with_name("isolated_worker.py")


class IsolatedLibrary:
    """A library and the process that runs it, started when it is first needed and again after a crash.

    `tasks` is the file whose TASKS the process answers, one request at a time; `package` what they
    import, `extra` the option of polarnet that installs it; `advice` ends the message about a file it cannot read.
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
        """The answer; RecordingError with what the library said, or where it crashed or took too long.

        RuntimeError that says what to install where the library is missing.
        """
        if sys.modules.get(self._package, True) is None or importlib.util.find_spec(self._package) is None:
            raise RuntimeError(f"{path.name}: this format needs {self._package}: pip install 'polarnet[{self._extra}]'")
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
            except BaseException:  # interrupted before the answer, which the next request must not get
                self._stop(process)
                raise
            finally:
                deadline.cancel()
        if kind == "error":
            raise RecordingError(f"{path.name}: {self._name} cannot read it: {answer}; {self._advice}")
        return answer

    def _running(self) -> "subprocess.Popen[bytes]":
        if self._owner != os.getpid() or self._process is None or self._process.poll() is not None:
            self._owner = os.getpid()  # a fork must not share its parent's
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(WORKER), str(self._tasks), str(LARGEST_MIB)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        return self._process

    def _stop(self, process: "subprocess.Popen[bytes]") -> None:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        self._process = None
