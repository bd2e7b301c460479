import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from polarnet.recordings.formats import isolated
from polarnet.recordings.formats.isolated import Library, ask, ask_once
from polarnet.recordings.source import RecordingError

TASKS = """
import os, time

import numpy as np


class Panic(BaseException):
    pass


def answers(path, count):
    for k in range(count):
        yield os.path.getsize(path), os.getpid(), np.arange(k), np.ones((k, 2), np.int8)


def panic(path):
    yield None
    raise Panic("out of bounds")


def crash(path):
    os.abort()


def circle(path):
    time.sleep(1000)


def claim(path, size):
    yield np.zeros(size, np.uint8)[:1]
"""
FILE = Path("file.bin")
LIBRARY = Library("Fragile", "numpy", "the file is damaged")


@pytest.fixture(autouse=True)
def file_and_tasks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(isolated, "_idle", [])
    FILE.write_bytes(bytes(5))
    (tmp_path / "fragile_tasks.py").write_text(TASKS)
    monkeypatch.delitem(sys.modules, "fragile_tasks", raising=False)


def task(name):
    return getattr(importlib.import_module("fragile_tasks"), name)


def process_of():
    return ask_once(LIBRARY, FILE, task("answers"), 1)[1]


def test_values_and_arrays_come_from_one_process_that_is_not_ours_also_for_two_tasks_at_a_time():
    (size, process, *_), (*_, numbers, ones) = ask(LIBRARY, FILE, task("answers"), 2)
    assert (size, numbers.tolist(), ones.tolist(), ones.dtype) == (5, [0], [[1, 1]], "int8")
    assert process == process_of() != os.getpid()
    one, two = (ask(LIBRARY, FILE, task("answers"), 3) for _ in range(2))
    sizes = [len(next(answers)[2]) for answers in (one, two, two, one, one, two)]
    assert sizes == [0, 0, 1, 1, 2, 2]


@pytest.mark.thorough
def test_a_script_without_a_guard_runs_once_and_leaves_no_process_and_no_pipe_open(project_root):
    Path("script.py").write_text(
        "from pathlib import Path\n"
        "import fragile_tasks\n"
        "from polarnet.recordings.formats.isolated import Library, ask_once\n"
        "library = Library('Fragile', 'numpy', '')\n"
        "print(ask_once(library, Path('file.bin'), fragile_tasks.answers, 1)[0])\n"
    )
    environment = os.environ | {"PYTHONPATH": str(project_root)}
    command = [sys.executable, "-X", "dev", "script.py"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert (done.stdout, done.stderr) == ("5\n", "")


def test_a_crash_or_an_endless_library_ends_in_a_reason_and_the_next_task_in_a_new_process(monkeypatch):
    before = process_of()
    with pytest.raises(RecordingError, match=r"file\.bin: Fragile cannot read it: the library crashed"):
        ask_once(LIBRARY, FILE, task("crash"))
    assert process_of() != before
    process_of()  # the start of a process takes longer
    monkeypatch.setattr(isolated, "PATIENCE_S", 0.2)
    with pytest.raises(RecordingError, match=r"file\.bin: .* took over 0\.2 s"):
        ask_once(LIBRARY, FILE, task("circle"))


def test_what_the_library_raises_is_the_reason_and_a_missing_library_is_asked_for():
    before = process_of()
    with pytest.raises(RecordingError, match=r"file\.bin: Fragile cannot read it: Panic: out of bounds; the file is"):
        list(ask(LIBRARY, FILE, task("panic")))
    assert process_of() == before
    with pytest.raises(RuntimeError, match=r"file\.bin: .* no_such_package: run pip install -e '\.\[recordings\]'"):
        ask_once(LIBRARY._replace(package="no_such_package"), FILE, task("answers"), 1)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the memory of a process")
def test_a_claim_beyond_the_limit_of_memory_is_refused(monkeypatch):
    monkeypatch.setattr(isolated, "MAX_MIB", 2048)
    assert ask_once(LIBRARY, FILE, task("claim"), 2**20).tolist() == [0]
    with pytest.raises(RecordingError, match="MemoryError"):
        ask_once(LIBRARY, FILE, task("claim"), 2**32)
