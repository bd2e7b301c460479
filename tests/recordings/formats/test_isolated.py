import os
import subprocess
import sys
from pathlib import Path

import pytest

from polarnet.recordings.formats import isolated
from polarnet.recordings.formats.isolated import IsolatedLibrary
from polarnet.recordings.source import RecordingError

TASKS = """
import os, time

import numpy as np



class Panic(BaseException):
    pass


def panic(path):
    raise Panic("out of bounds")


TASKS = {
    "size": lambda path, more: os.path.getsize(path) + more,
    "process": lambda path: os.getpid(),
    "crash": lambda path: os.abort(),
    "circle": lambda path: time.sleep(1000),
    "claim": lambda path, size: np.zeros(size, np.uint8).shape,
    "panic": panic,
}
"""
FILE = Path("file.bin")


@pytest.fixture
def library(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    FILE.write_bytes(bytes(5))
    (tmp_path / "tasks.py").write_text(TASKS)
    return IsolatedLibrary("Fragile", "numpy", "recordings", tmp_path / "tasks.py", "the file is damaged")


def test_requests_are_answered_by_one_process_that_is_not_ours(library):
    assert library.ask(FILE, "size", 2) == 7
    assert library.ask(FILE, "process") == library.ask(FILE, "process") != os.getpid()


def test_a_program_that_ends_leaves_no_process_and_no_pipe_open(library, project_root):
    script = "from pathlib import Path; from polarnet.recordings.formats.isolated import IsolatedLibrary as Library; "
    script += "library = Library('Fragile', 'numpy', 'recordings', Path('tasks.py'), ''); "
    script += "print(library.ask(Path('file.bin'), 'size', 2))"
    command = [sys.executable, "-X", "dev", "-c", script]
    environment = os.environ | {"PYTHONPATH": str(project_root)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert (done.stdout, done.stderr) == ("7\n", "")


def test_a_crash_ends_in_a_reason_and_the_next_request_in_a_new_process(library):
    before = library.ask(FILE, "process")
    with pytest.raises(RecordingError, match=r"file\.bin: Fragile cannot read it: the library crashed"):
        library.ask(FILE, "crash")
    assert library.ask(FILE, "process") != before


def test_a_file_that_sends_the_library_round_in_circles_is_given_up(library, monkeypatch):
    monkeypatch.setattr(isolated, "PATIENCE_S", 0.2)
    with pytest.raises(RecordingError, match=r"file\.bin: .* took over 0\.2 s"):
        library.ask(FILE, "circle")


@pytest.mark.parametrize(
    ("task", "arguments", "message"),
    [("panic", (), "Panic: out of bounds; the file is damaged"), ("claim", (2**44,), "MemoryError")],
)
def test_what_the_library_raises_is_the_reason(library, task, arguments, message):
    with pytest.raises(RecordingError, match=rf"file\.bin: Fragile cannot read it: .*{message}"):
        library.ask(FILE, task, *arguments)


def test_a_library_that_is_not_there_is_asked_for():
    library = IsolatedLibrary("None", "no_such_package", "recordings", FILE, "")
    with pytest.raises(RuntimeError, match=r"file\.bin: .* no_such_package: run pip install -e '\.\[recordings\]'"):
        library.ask(FILE, "size")


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the memory of a process")
def test_a_claim_beyond_the_limit_of_memory_is_refused(library, monkeypatch):
    monkeypatch.setattr(isolated, "MAX_MIB", 2048)
    assert library.ask(FILE, "claim", 2**20) == (2**20,)
    with pytest.raises(RecordingError, match="MemoryError"):
        library.ask(FILE, "claim", 2**32)
