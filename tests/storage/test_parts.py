"""The protocol that all stores share: make, resume, finish, open, and survive being killed."""

import asyncio
import functools
import hashlib
import json
import os
import pickle
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

import polarnet.storage.parts as parts_module
from polarnet.storage.parts import Column, StorageConfig, Store, open_group

NAMES = [f"s{i}" for i in range(5)]
SEQUENCES_PER_PART = 2


class Numbers(Store):
    """Ragged numbers and pairs, by 1024 rows a chunk."""

    FORMAT = "test.numbers"
    VERSION = 3

    @functools.cached_property
    def columns(self):
        return {"group/value": Column("long", "uint16", 1024), "pair": Column("short", "int64", 4, (2,))}


class Others(Numbers):
    FORMAT = "test.others"


class Later(Numbers):
    VERSION = 4


def store_at(path: Path, **attributes) -> Numbers:
    return Numbers.create_parts(path, NAMES, attributes, SEQUENCES_PER_PART)


def values_of(name: str) -> np.ndarray:
    number = NAMES.index(name)
    return np.random.default_rng(number).integers(0, 180, 3000 * number).astype(np.uint16)


def pairs_of(name: str) -> np.ndarray:
    return np.arange(10).reshape(5, 2) + NAMES.index(name)


def write(store: Numbers, name: str) -> None:
    store.append(name, {"group/value": values_of(name), "pair": pairs_of(name)}, {"number": NAMES.index(name)})


def write_missing_and_finish(path: Path) -> None:
    store = store_at(path)
    for name in store.missing():
        write(store, name)
    store.finish()


def digest(folder: Path) -> dict[str, str]:
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


@pytest.fixture(scope="module", autouse=True)
def _several_shards():
    """Shards of four chunks of values."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts_module, "SHARD_BYTES", 2**13)
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("parts") / "store.zarr"
    write_missing_and_finish(path)
    return path


@pytest.fixture
def copy(finished, tmp_path) -> Path:
    return shutil.copytree(finished, tmp_path / "copy.zarr")


def assert_whole(store: Numbers) -> None:
    for name in NAMES:
        assert store.record(name)["number"] == NAMES.index(name)
        assert np.array_equal(store.read_column("group/value", name), values_of(name))
        assert np.array_equal(store.read_column("pair", name), pairs_of(name))


def test_sequences_come_back(finished):
    store = Numbers.open(finished)
    assert store.parts == {"part-00000": ["s0", "s1"], "part-00001": ["s2", "s3"], "part-00002": ["s4"]}
    assert_whole(store)
    assert_whole(pickle.loads(pickle.dumps(store)))


def test_rows_are_counted_within_their_sequence(finished):
    store = Numbers.open(finished)
    assert np.array_equal(store.read_column("group/value", "s3", 2000, 5000), values_of("s3")[2000:5000])
    assert len(store.read_column("group/value", "s2", 5990, 7000)) == 10
    assert len(store.read_column("group/value", "s0")) == 0
    long, short = store.read_columns("s4", [("group/value", 11_999, None), ("pair", 0, 1)])
    assert (len(long), short.tolist()) == (1, [[4, 5]])


def test_any_zarr_reader_finds_a_sequence_by_the_record_of_its_part(finished):
    part = zarr.open_group(finished, mode="r")["part-00001"]
    start, stop = part.attrs["sequences"]["s3"]["long"]
    assert np.array_equal(part["group/value"][start:stop], values_of("s3"))
    assert part["group/value"].shards == (4096,)


def test_every_sequence_starts_a_chunk_of_its_own(finished):
    part = zarr.open_group(finished, mode="r")["part-00001"]
    assert part.attrs["sequences"]["s2"]["long"] == [0, 6000]
    assert part.attrs["sequences"]["s3"]["long"] == [6 * 1024, 6 * 1024 + 9000]
    assert part.attrs["sequences"]["s3"]["short"] == [8, 13]


def test_the_order_of_the_parts_and_what_was_begun_before_leave_no_trace(finished, tmp_path):
    store = store_at(tmp_path / "store.zarr")
    write(store, "s2")  # begun, and begun again below
    for name in ["s4", "s2", "s3", "s0", "s1"]:
        write(store, name)
    store.finish()
    assert digest(tmp_path / "store.zarr") == digest(finished)


def test_a_part_takes_its_sequences_in_order(tmp_path):
    store = store_at(tmp_path / "store.zarr")
    with pytest.raises(ValueError, match="part-00001 takes its sequences in order, expected s2, got s3"):
        write(store, "s3")
    write(store, "s2")
    assert store.missing() == NAMES


def test_of_two_processes_that_write_a_part_the_first_one_gives_it_its_name(tmp_path, finished):
    one, two = store_at(tmp_path / "store.zarr"), store_at(tmp_path / "store.zarr")
    for name in NAMES:
        write(one, name)
        write(two, name)
    two.finish()
    assert digest(tmp_path / "store.zarr") == digest(finished)


def test_an_unfinished_store_with_an_equal_header_keeps_its_parts(tmp_path):
    store = store_at(tmp_path / "store.zarr", seed=1)
    for name in ("s0", "s2", "s3", "s4"):  # the first part is begun only
        write(store, name)
    assert store_at(tmp_path / "store.zarr", seed=1).missing() == ["s0", "s1"]
    assert store_at(tmp_path / "store.zarr", seed=1).missing_parts() == ["part-00000"]


def test_an_unfinished_store_with_another_header_is_removed(tmp_path):
    write(store_at(tmp_path / "store.zarr", seed=1), "s4")
    assert store_at(tmp_path / "store.zarr", seed=2).missing() == NAMES
    write(store_at(tmp_path / "store.zarr", seed=2), "s4")
    assert Numbers.create_parts(tmp_path / "store.zarr", NAMES, {"seed": 2}, 3).missing() == NAMES


def test_a_finished_store_replaces_the_one_that_was_there(tmp_path, copy):
    store = store_at(copy, seed=2)
    assert Numbers.open(copy).attributes == {}
    for name in NAMES:
        write(store, name)
    store.finish()
    assert Numbers.open(copy).attributes == {"seed": 2}
    assert [path.name for path in tmp_path.iterdir()] == ["copy.zarr"]


def test_a_sequence_that_does_not_exist_is_refused(finished):
    with pytest.raises(ValueError, match="there is no 's9' among its 5 sequences"):
        Numbers.open(finished).record("s9")


def test_a_file_holds_at_most_256_chunks_so_that_the_index_at_its_end_stays_small():
    assert Column("frames", "int64", 1).shard == 256
    assert Column("frames", "uint16", 2**10, (4,)).shard == 2**10  # a chunk of SHARD_BYTES, 2**13 in these tests


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
            write_missing_and_finish(path)
        except Killed:
            deaths += 1
            sync(asyncio.sleep(0.01))  # writes that were waiting for their turn die as well
            with one_at_a_time:  # and the one that was under way has ended
                pass
        else:
            break
        finally:
            monkeypatch.setattr(zarr.storage._local, "_put", put)
        write_missing_and_finish(path)
        assert digest(path) == digest(finished)
    assert deaths > 3 * len(NAMES)


@pytest.mark.parametrize("last", ["part-00001", "store.zarr"])
def test_a_store_killed_before_any_of_its_renames_is_finished_by_the_rerun(finished, tmp_path, last):
    path = tmp_path / "store.zarr"
    shutil.copytree(finished, path)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("rename", "replace"):
            patch.setattr(os, name, functools.partial(_rename_or_die, getattr(os, name), last))
        with pytest.raises(Killed):
            write_missing_and_finish(path)
    if last == "store.zarr":
        with pytest.raises(FileNotFoundError, match=r"store\.zarr\.tmp is unfinished"):
            Numbers.open(path)
        assert store_at(path).missing() == []
    else:
        assert store_at(path).missing_parts() == ["part-00001", "part-00002"]
    write_missing_and_finish(path)
    assert digest(path) == digest(finished)
    assert [entry.name for entry in tmp_path.iterdir()] == ["store.zarr"]


def _rename_or_die(rename, last: str, source, target) -> None:
    if Path(target).name == last:
        raise Killed
    rename(source, target)


def test_a_process_killed_at_any_moment_leaves_parts_whole_or_missing(finished, tmp_path):
    path = tmp_path / "store.zarr"
    script = "import sys, test_parts as t; t._write_slowly(sys.argv[1])"
    done = set()
    for milliseconds in (2, 15, 30, 45):
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
        store = store_at(path)
        left = store.missing()
        for name in set(NAMES) - set(left):
            assert np.array_equal(store.read_column("group/value", name), values_of(name))
        assert done <= set(NAMES) - set(left)
        done = set(NAMES) - set(left)
    write_missing_and_finish(path)
    assert digest(path) == digest(finished)


def _write_slowly(path: str) -> None:
    parts_module.SHARD_BYTES = 2**13
    store = store_at(Path(path))
    print("ready", flush=True)
    for name in store.missing():
        write(store, name)
        time.sleep(0.01)
    time.sleep(60)


def test_every_flipped_bit_is_an_error(copy):
    for file in [file for file in copy.rglob("*") if file.is_file()]:
        content = file.read_bytes()
        for place in {0, len(content) // 3, len(content) // 2, len(content) - 1}:
            damaged = bytearray(content)
            damaged[place] ^= 1 << (place % 8)
            file.write_bytes(damaged)
            assert Numbers.verify(copy), (file, place)
        file.write_bytes(content)
    assert Numbers.verify(copy) == []


def test_a_missing_or_cut_file_is_an_error_that_names_it_with_sequence_and_column(copy):
    for name, column in (("part-00001/group/value/c/1", "group/value"), ("part-00001/pair/c/0/0", "pair")):
        content = (copy / name).read_bytes()
        (copy / name).write_bytes(content[:-3])
        assert any(f"s3, column {column} is unreadable" in problem for problem in Numbers.verify(copy))
        (copy / name).write_bytes(b"")
        assert any(f"s3, column {column} is unreadable" in problem for problem in Numbers.verify(copy))
        (copy / name).unlink()
        message = f"s3, column {column} is unreadable: there is no {name}"
        assert any(message in problem for problem in Numbers.verify(copy))
        (copy / name).write_bytes(content)
    shutil.rmtree(copy / "part-00002")
    assert any("s4, part-00002/zarr.json is unreadable" in problem for problem in Numbers.verify(copy))


def test_a_part_of_another_place_is_an_error(copy):
    shutil.rmtree(copy / "part-00000")
    shutil.copytree(copy / "part-00001", copy / "part-00000")
    with pytest.raises(ValueError, match=r"s0, part-00000/zarr.json is unreadable: .* not what was written"):
        Numbers.open(copy).record("s0")


def test_a_zip_and_a_url_are_read_and_verified_like_the_folder(finished, tmp_path):
    with zipfile.ZipFile(tmp_path / "store.zip", "w") as archive:
        for file in sorted(finished.rglob("*")):
            archive.write(file, file.relative_to(finished))
    fsspec.filesystem("memory").put(str(finished), "/bucket/store.zarr", recursive=True)
    try:
        for path in (tmp_path / "store.zip", "memory://bucket/store.zarr", finished.as_uri()):
            assert_whole(Numbers.open(path))
            assert Numbers.verify(path) == []
    finally:
        fsspec.filesystem("memory").rm("/bucket", recursive=True)


def test_what_is_not_a_finished_store_of_this_version_is_refused(finished, copy, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.zarr: there is no Zarr v3 group; run the stage"):
        Numbers.open(tmp_path / "nothing.zarr")
    with pytest.raises(FileNotFoundError, match="there is no Zarr v3 group"):
        Numbers.open("memory://bucket/nothing.zarr")
    with pytest.raises(ValueError, match=r"expected a store of format 'test\.others', got 'test\.numbers'"):
        Others.open(finished)
    with pytest.raises(ValueError, match=r"expected version 4 of test\.numbers, got version 3 .* run `dvc repro`"):
        Later.open(finished)
    (tmp_path / "text.zip").write_text("not a zip")
    with pytest.raises(ValueError, match=r"text\.zip is unreadable"):
        Numbers.open(tmp_path / "text.zip")
    with pytest.raises(ValueError, match="never finished"):
        Numbers.open(_with_attribute(copy, "complete", False))
    with pytest.raises(ValueError, match=r"attributes in zarr\.json are not what was written"):
        Numbers.open(_with_attribute(copy, "sequences", [*NAMES[:-1], "s7"], "complete", True))


def _with_attribute(path: Path, *names_and_values) -> Path:
    header = json.loads((path / "zarr.json").read_text())
    header["attributes"].update(zip(names_and_values[::2], names_and_values[1::2], strict=True))
    (path / "zarr.json").write_text(json.dumps(header))
    return path


def test_attributes_that_json_cannot_hold_are_refused(tmp_path):
    with pytest.raises(ValueError, match="finite, plain JSON"):
        store_at(tmp_path / "store.zarr", threshold=float("nan"))
    with pytest.raises(ValueError, match="finite, plain JSON"):
        store_at(tmp_path / "store.zarr", root=tmp_path)


def test_a_part_holds_at_least_one_sequence(tmp_path):
    with pytest.raises(ValueError, match="at least one sequence per part, got 0"):
        Numbers.create_parts(tmp_path / "store.zarr", NAMES, {}, 0)
    with pytest.raises(ValueError, match="sequences_per_part: expected > 0, got 0"):
        StorageConfig(sequences_per_part=0)


@pytest.mark.parametrize("content", ["6", "[]", "{"])
def test_a_damaged_header_is_unreadable_by_name(tmp_path, content):
    (tmp_path / "store.zarr").mkdir()
    (tmp_path / "store.zarr" / "zarr.json").write_text(content)
    with pytest.raises(ValueError, match=r"store\.zarr is unreadable"):
        open_group(tmp_path / "store.zarr")
