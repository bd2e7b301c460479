"""The protocol that all stores share: make, resume, finish, open, and survive being killed."""

import asyncio
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path

import fsspec
import numpy as np
import pytest
import zarr.storage._local
from zarr.core.sync import sync

from polarnet.storage.table import Column, Table, create_table, open_group, open_table

ROWS = [f"row{i}" for i in range(4)]
LENGTH = 3000


def columns_of(attributes: dict) -> dict[str, Column]:
    rows = attributes["rows"]
    return {
        "group/value": Column(rows, (2**30,), (1024,), (4096,), "uint16", 2**16 - 1, False, "bitshuffle"),
        "commit": Column(rows, (2,), (2,), (2,), "int64", -1, False, "shuffle"),
    }


def table_at(path: Path, **attributes) -> Table:
    attributes = {"rows": ROWS, **attributes}
    return create_table(path, "test", 3, attributes, columns_of(attributes))


def opened(path: str | Path) -> Table:
    return open_table(path, "test", 3, columns_of)


def values_of(row: str) -> np.ndarray:
    generator = np.random.default_rng(ROWS.index(row))
    return generator.integers(0, 180, LENGTH + 3000 * ROWS.index(row)).astype(np.uint16)


def write_row(table: Table, row: str) -> None:
    table.write("group/value", row, values_of(row))
    table.write("commit", row, np.array([0, len(values_of(row))]))


def missing(table: Table) -> list[str]:
    return [row for row in ROWS if not table.is_written("commit", row)]


def finish(table: Table) -> None:
    table.finish({"group/value": (len(values_of(ROWS[-1])),)})


def digest(folder: Path) -> dict[str, str]:
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("table") / "store.zarr"
    table = table_at(path)
    for row in ROWS:
        write_row(table, row)
    finish(table)
    return path


@pytest.fixture
def copy(finished, tmp_path) -> Path:
    return shutil.copytree(finished, tmp_path / "copy.zarr")


def assert_whole(table: Table) -> None:
    for row in ROWS:
        start, stop = table.read("commit", row).tolist()
        assert np.array_equal(table.read("group/value", row, slice(start, stop)), values_of(row))


def test_rows_come_back(finished):
    assert_whole(opened(finished))


def test_the_order_of_writing_and_what_a_row_held_before_leave_no_trace(finished, tmp_path):
    table = table_at(tmp_path / "store.zarr")
    table.write("group/value", "row0", np.arange(50_000, dtype=np.uint16))  # more files than what replaces it
    table.write("group/value", "row1", np.arange(4090, dtype=np.uint16))
    for row in [*reversed(ROWS), "row2"]:
        write_row(table, row)
    finish(table)
    assert digest(tmp_path / "store.zarr") == digest(finished)


def test_an_unfinished_table_with_equal_attributes_keeps_its_rows(tmp_path):
    write_row(table_at(tmp_path / "store.zarr", seed=1), "row3")
    assert missing(table_at(tmp_path / "store.zarr", seed=1)) == [row for row in ROWS if row != "row3"]


def test_an_unfinished_table_with_other_attributes_is_removed(tmp_path):
    write_row(table_at(tmp_path / "store.zarr", seed=1), "row3")
    assert missing(table_at(tmp_path / "store.zarr", seed=2)) == ROWS


def test_a_finished_table_replaces_the_one_that_was_there(tmp_path, copy):
    table = table_at(copy, seed=2)
    assert opened(copy).attributes.get("seed") is None
    for row in ROWS:
        write_row(table, row)
    finish(table)
    assert opened(copy).attributes["seed"] == 2
    assert [path.name for path in tmp_path.iterdir()] == ["copy.zarr"]


def test_a_row_that_does_not_exist_is_refused(finished):
    with pytest.raises(ValueError, match="there is no 'row9' among its 4 rows"):
        opened(finished).read("commit", "row9")


class Killed(BaseException):
    """Stands for SIGKILL: zarr, which cleans up after an Exception, gets no chance to."""


def test_whichever_file_a_writer_dies_in_the_rerun_ends_with_the_same_bytes(finished, tmp_path, monkeypatch):
    """Every other time it dies in the middle of the file, else just before the file gets its name."""
    put = zarr.storage._local._put
    path = tmp_path / "store.zarr"
    deaths = 0
    for n in range(10_000):
        count = iter(range(10_000))
        one_at_a_time = threading.Lock()  # zarr writes from several threads, which would outlive a death that is acted

        def put_or_die(target, value, exclusive=False, count=count, n=n, lock=one_at_a_time):
            with lock:
                if next(count) < n:
                    return put(target, value, exclusive)
            target.parent.mkdir(parents=True, exist_ok=True)
            content = bytes(value.as_buffer_like())
            target.with_suffix(".0123.partial").write_bytes(content[: len(content) // (1 + n % 2)])
            raise Killed

        shutil.rmtree(path, ignore_errors=True)
        shutil.rmtree(f"{path}.tmp", ignore_errors=True)
        monkeypatch.setattr(zarr.storage._local, "_put", put_or_die)
        try:
            _write_missing_and_finish(path)
        except Killed:
            deaths += 1
            sync(asyncio.sleep(0.01))  # writes that were waiting for their turn die as well
            with one_at_a_time:  # and the one that was under way has ended
                pass
        else:
            break
        finally:
            monkeypatch.setattr(zarr.storage._local, "_put", put)
        _write_missing_and_finish(path)
        assert digest(path) == digest(finished)
    assert deaths > 3 * len(ROWS)


def _write_missing_and_finish(path: Path) -> None:
    table = table_at(path)
    for row in missing(table):
        write_row(table, row)
    finish(table)


def test_a_table_killed_between_its_two_renames_is_finished_by_the_rerun(finished, tmp_path, monkeypatch):
    path = tmp_path / "store.zarr"
    shutil.copytree(finished, path)
    table = table_at(path)
    for row in ROWS:
        write_row(table, row)
    replace = os.replace

    def die_before_the_second(source, target):
        if str(source).endswith(".tmp"):
            raise Killed
        replace(source, target)

    monkeypatch.setattr(os, "replace", die_before_the_second)
    with pytest.raises(Killed):
        finish(table)
    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(FileNotFoundError, match=r"store\.zarr\.tmp is unfinished"):
        opened(path)
    again = table_at(path)
    assert missing(again) == []
    finish(again)
    assert digest(path) == digest(finished)
    assert [entry.name for entry in tmp_path.iterdir()] == ["store.zarr"]


def test_a_process_killed_at_any_moment_leaves_rows_whole_or_missing(finished, tmp_path):
    path = tmp_path / "store.zarr"
    script = "import sys, test_table as t; t._write_slowly(sys.argv[1])"
    done = set()
    for milliseconds in (2, 8, 15, 23):
        writer = subprocess.Popen(
            [sys.executable, "-c", script, str(path)],
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])},
        )
        assert writer.stdout is not None
        assert writer.stdout.readline() == b"ready\n"
        time.sleep(milliseconds / 1000)
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        table = table_at(path)
        left = missing(table)
        for row in set(ROWS) - set(left):
            assert np.array_equal(table.read("group/value", row, slice(len(values_of(row)))), values_of(row))
        assert done <= set(ROWS) - set(left)
        done = set(ROWS) - set(left)
    _write_missing_and_finish(path)
    assert digest(path) == digest(finished)


def _write_slowly(path: str) -> None:
    table = table_at(Path(path))
    print("ready", flush=True)
    for row in reversed(missing(table)):
        write_row(table, row)
        time.sleep(0.01)
    time.sleep(60)


def test_every_flipped_bit_is_an_error(copy):
    for file in [file for file in copy.rglob("*") if file.is_file()]:
        content = file.read_bytes()
        for place in {0, len(content) // 3, len(content) // 2, len(content) - 1}:
            damaged = bytearray(content)
            damaged[place] ^= 1 << (place % 8)
            file.write_bytes(damaged)
            assert _problems(copy), (file, place)
        file.write_bytes(content)
    assert _problems(copy) == []


def test_a_missing_or_cut_file_is_an_error_that_names_row_and_column(copy):
    for name, column in (("group/value/c/2/0", "group/value"), ("commit/c/2/0", "commit")):
        content = (copy / name).read_bytes()
        (copy / name).write_bytes(content[:-3])
        assert any(f"row2, column {column} is unreadable" in problem for problem in _problems(copy))
        (copy / name).write_bytes(b"")
        assert any(f"row2, column {column} is unreadable" in problem for problem in _problems(copy))
        (copy / name).unlink()
        assert any(f"row2, column {column} is unreadable: there is no c/2/0" in problem for problem in _problems(copy))
        (copy / name).write_bytes(content)


def _problems(path: Path) -> list[str]:
    try:
        table = opened(path)
    except (ValueError, FileNotFoundError) as error:
        return [str(error)]
    problems = table.metadata_problems()
    for row in ROWS:
        for name, window in (("commit", ()), ("group/value", (slice(len(values_of(row))),))):
            try:
                table.read(name, row, *window)
            except ValueError as error:
                problems.append(str(error))
    return problems


def test_a_zip_and_a_url_are_read_like_the_folder(finished, tmp_path):
    with zipfile.ZipFile(tmp_path / "store.zip", "w") as archive:
        for file in sorted(finished.rglob("*")):
            archive.write(file, file.relative_to(finished))
    fsspec.filesystem("memory").put(str(finished), "/bucket/store.zarr", recursive=True)
    try:
        for path in (tmp_path / "store.zip", "memory://bucket/store.zarr", finished.as_uri()):
            assert_whole(opened(path))
    finally:
        fsspec.filesystem("memory").rm("/bucket", recursive=True)


def test_what_is_not_a_finished_table_of_this_version_is_refused(finished, copy, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.zarr: there is no Zarr v3 group; run the stage"):
        opened(tmp_path / "nothing.zarr")
    with pytest.raises(FileNotFoundError, match="there is no Zarr v3 group"):
        opened("memory://bucket/nothing.zarr")
    with pytest.raises(ValueError, match="expected a store of format 'other', got 'test'"):
        open_table(finished, "other", 3, columns_of)
    with pytest.raises(ValueError, match="reads version 2 of test, the store is of version 3"):
        open_table(finished, "test", 2, columns_of)
    (tmp_path / "text.zip").write_text("not a zip")
    with pytest.raises(ValueError, match=r"text\.zip is unreadable"):
        opened(tmp_path / "text.zip")
    with pytest.raises(ValueError, match="never finished"):
        opened(_with_attribute(copy, "complete", False))
    with pytest.raises(ValueError, match=r"attributes in zarr\.json are not what was written"):
        opened(_with_attribute(copy, "rows", [*ROWS[:-1], "row7"], "complete", True))


def _with_attribute(path: Path, *names_and_values) -> Path:
    header = json.loads((path / "zarr.json").read_text())
    header["attributes"].update(zip(names_and_values[::2], names_and_values[1::2], strict=True))
    (path / "zarr.json").write_text(json.dumps(header))
    return path


def test_attributes_that_json_cannot_hold_are_refused(tmp_path):
    with pytest.raises(ValueError, match="finite, plain JSON"):
        table_at(tmp_path / "store.zarr", threshold=float("nan"))
    with pytest.raises(ValueError, match="finite, plain JSON"):
        table_at(tmp_path / "store.zarr", root=tmp_path)


@pytest.mark.parametrize("content", ["6", "[]", "{"])
def test_a_damaged_header_is_unreadable_by_name(tmp_path, content):
    (tmp_path / "store.zarr").mkdir()
    (tmp_path / "store.zarr" / "zarr.json").write_text(content)
    with pytest.raises(ValueError, match=r"store\.zarr is unreadable"):
        open_group(tmp_path / "store.zarr")
