"""The protocol that all stores share: make, resume, finish, open, and survive being killed."""

import contextlib
import errno
import functools
import gc
import hashlib
import json
import os
import pickle
import shutil
import signal
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import fsspec
import numpy as np
import pytest
import zarr
from part_fixtures import entries_to_change
from zarr.storage import ZipStore

import polarnet.storage.parts as parts_module
from polarnet.storage.groups import Column, open_group, raise_shortage
from polarnet.storage.parts import StorageConfig, Store

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
    part = zarr.open_group(ZipStore(finished / "part-00001.zip"), mode="r")
    start, stop = part.attrs["sequences"]["s3"]["long"]
    assert np.array_equal(part["group/value"][start:stop], values_of("s3"))


def test_every_sequence_starts_a_chunk_of_its_own(finished):
    part = zarr.open_group(ZipStore(finished / "part-00001.zip"), mode="r")
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


def test_a_disk_without_room_for_the_missing_parts_ends_the_writing_and_a_larger_one_takes_them(
    finished, tmp_path, monkeypatch
):
    usage, free = shutil.disk_usage(tmp_path), 0
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=free))
    store = store_at(tmp_path / "store.zarr")
    write(store, "s0")
    with pytest.raises(
        OSError, match=r"store.zarr.tmp: the 2 missing parts need about 0\.\d MiB, the disk has 0\.0 MiB"
    ):
        write(store, "s1")
    assert store.missing() == ["s2", "s3", "s4"]
    free = 2 * (finished / "part-00001.zip").stat().st_size
    for name in store.missing():
        write(store, name)
    store.finish()
    assert digest(tmp_path / "store.zarr") == digest(finished)


def test_two_processes_that_write_one_part_leave_the_bytes_of_one(tmp_path, finished):
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
    with pytest.raises(ValueError, match=r"expected a sequence of s0, s1, s2, s3, s4; got 's9'"):
        Numbers.open(finished).record("s9")


def test_a_part_is_one_file_without_a_date_or_compression_of_its_own(finished):
    assert sorted(file.name for file in finished.iterdir()) == [*(f"part-0000{k}.zip" for k in range(3)), "zarr.json"]
    with zipfile.ZipFile(finished / "part-00001.zip") as part:
        entries = part.infolist()
        assert len({entry.filename for entry in entries}) == len(entries)
        assert {(entry.date_time, entry.compress_type) for entry in entries} == {((1980, 1, 1, 0, 0, 0), 0)}


def test_more_parts_are_read_than_files_may_be_open(finished, monkeypatch):
    monkeypatch.setattr(parts_module, "MAX_OPEN_PARTS", 1)
    before = len(os.listdir("/proc/self/fd"))
    store = Numbers.open(finished)
    for _ in range(3):
        assert_whole(store)
    assert len(os.listdir("/proc/self/fd")) <= before + 1


def test_a_lack_of_descriptors_is_no_damage(finished, monkeypatch):
    def refuse(path):
        raise_shortage(OSError(errno.EMFILE, "Too many open files"), path)

    store = Numbers.open(finished)
    monkeypatch.setattr(parts_module, "open_group", refuse)
    for read in (store.record, functools.partial(store.read_column, next(iter(store.columns)))):
        with pytest.raises(RuntimeError, match="was not read, because the system gave no more") as refusal:
            read(store.sequences[0])
        assert "unreadable" not in str(refusal.value)


def test_a_lack_of_threads_is_no_damage(finished, monkeypatch):
    def refuse(*_):
        raise RuntimeError("can't start new thread")

    store = Numbers.open(finished)
    monkeypatch.setattr(threading, "_start_new_thread", refuse)
    with pytest.raises(RuntimeError, match="was not read, because the system gave no more") as refusal:
        store.read_columns(store.sequences[0], [(name, 0, None) for name in store.columns])
    assert str(finished) in str(refusal.value)


def test_a_forked_process_shares_no_open_file_with_its_parent(finished):
    store = Numbers.open(finished)
    assert_whole(store)
    with ProcessPoolExecutor(2, mp_context=get_context("fork")) as pool:
        readers = [pool.submit(assert_whole, store) for _ in range(8)]
        for _ in range(8):
            assert_whole(store)
        assert [reader.result(60) for reader in readers] == [None] * 8


class Killed(BaseException):
    """Stands for SIGKILL: zarr, which cleans up after an Exception, gets no chance to."""


def test_whichever_write_a_writer_dies_in_the_rerun_ends_with_the_same_bytes(finished, tmp_path, monkeypatch):
    """Every other time it dies in the middle of an entry of a part, else just before or after it."""
    writestr = zipfile.ZipFile.writestr
    path = tmp_path / "store.zarr"
    deaths = 0
    for n in range(10_000):
        count = iter(range(10_000))

        def write_or_die(archive, entry, content, count=count, n=n):
            if next(count) < n:
                return writestr(archive, entry, content)
            if n % 2:
                archive.fp.write(content[: len(content) // 2])
            archive.fp.flush()
            raise Killed

        shutil.rmtree(path, ignore_errors=True)
        shutil.rmtree(f"{path}.tmp", ignore_errors=True)
        monkeypatch.setattr(zipfile.ZipFile, "writestr", write_or_die)
        try:
            write_missing_and_finish(path)
        except Killed:
            deaths += 1
        else:
            break
        finally:
            monkeypatch.setattr(zipfile.ZipFile, "writestr", writestr)
        write_missing_and_finish(path)
        assert digest(path) == digest(finished)
    assert deaths > 3 * len(NAMES)


@pytest.mark.parametrize("last", ["part-00001.zip", "store.zarr"])
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
    done = set()
    for milliseconds in (2, 15, 30, 45):
        with forked(_write_slowly, path) as writer:
            time.sleep(milliseconds / 1000)
        assert writer.exitcode == -signal.SIGKILL
        store = store_at(path)
        left = store.missing()
        for name in set(NAMES) - set(left):
            assert np.array_equal(store.read_column("group/value", name), values_of(name))
        assert done <= set(NAMES) - set(left)
        done = set(NAMES) - set(left)
        del store
        gc.collect()  # the claim on the path ends with the store
    write_missing_and_finish(path)
    assert digest(path) == digest(finished)


def test_a_second_writer_is_refused_while_the_first_lives(tmp_path):
    path = tmp_path / "store.zarr"
    message = r"store\.zarr: another process is writing it; wait until that has ended"
    with forked(_claim, path), pytest.raises(ValueError, match=message):
        store_at(path)
    write_missing_and_finish(path)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["store.zarr"]


@contextlib.contextmanager
def forked(write: Callable[[Path, Connection], None], path: Path) -> Iterator[BaseProcess]:
    """A process that has claimed a store and is killed at the end of the block."""
    claimed, sender = Pipe(duplex=False)
    process = get_context("fork").Process(target=write, args=(path, sender))
    process.start()
    try:
        assert claimed.poll(60), "the process claims nothing"
        yield process
    finally:
        process.kill()
        process.join()


def _claim(path: Path, claimed: Connection) -> None:
    _store = store_at(path)
    claimed.send(True)
    signal.pause()


def _write_slowly(path: Path, claimed: Connection) -> None:
    store = store_at(path)
    claimed.send(True)
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


def test_a_missing_or_cut_chunk_or_file_is_an_error_that_names_it_with_sequence_and_column(copy):
    part = copy / "part-00001.zip"
    content = part.read_bytes()
    for name, column in (("group/value/c/8", "group/value"), ("pair/c/2/0", "pair")):
        for length in (-3, 0, None):
            with entries_to_change(part) as entries:
                chunk = entries.pop(name)
                if length is not None:
                    entries[name] = chunk[:length]
            (problem,) = Numbers.verify(copy)
            assert f"s3, column {column} is unreadable: part-00001.zip: " in problem
            assert length == -3 or f"there is no {name}, or nothing in it" in problem
            part.write_bytes(content)
    for length in (len(content) - 3, len(content) // 2, 0):
        part.write_bytes(content[:length])
        assert Numbers.verify(copy)
    part.write_bytes(content)
    (copy / "part-00002.zip").unlink()
    assert any("s4, part-00002.zip is unreadable" in problem for problem in Numbers.verify(copy))


def test_a_part_of_another_place_is_an_error(copy):
    shutil.copy(copy / "part-00001.zip", copy / "part-00000.zip")
    with pytest.raises(ValueError, match=r"s0, part-00000\.zip is unreadable: it is not the part that was written"):
        Numbers.open(copy).record("s0")


def test_an_older_part_of_the_same_sequences_is_an_error(copy, tmp_path):
    other = store_at(tmp_path / "other.zarr")
    for name in NAMES:
        other.append(name, {"group/value": values_of(name)[::-1], "pair": pairs_of(name)}, {"number": 0})
    other.finish()
    shutil.copy(tmp_path / "other.zarr" / "part-00000.zip", copy / "part-00000.zip")
    with pytest.raises(ValueError, match=r"s0, part-00000\.zip is unreadable: it is not the part that was written"):
        Numbers.open(copy).record("s0")
    (problem,) = {message for message in Numbers.verify(copy) if "not as it was written" in message}
    assert "part-00000.zip" in problem


def test_a_url_is_read_and_verified_like_the_folder(finished):
    fsspec.filesystem("memory").put(str(finished), "/bucket/store.zarr", recursive=True)
    try:
        for path in ("memory://bucket/store.zarr", finished.as_uri()):
            assert_whole(Numbers.open(path))
            assert Numbers.verify(path) == []
    finally:
        fsspec.filesystem("memory").rm("/bucket", recursive=True)


def test_a_url_is_written_and_resumed_like_a_folder(finished):
    bucket, url = fsspec.filesystem("memory"), "memory://written/store.zarr"
    try:
        killed = store_at(url)
        for name in killed.parts["part-00000"]:
            write(killed, name)
        before = bucket.modified("/written/store.zarr/part-00000.zip")
        with pytest.raises(ValueError, match="the store was never finished"):
            Numbers.open(url)
        with pytest.raises(ValueError, match="expected nothing there, or this store unfinished, got another"):
            store_at(url, other=1)
        write_missing_and_finish(url)
        assert bucket.modified("/written/store.zarr/part-00000.zip") == before
        for file in finished.iterdir():
            assert bucket.cat(f"/written/store.zarr/{file.name}") == file.read_bytes()
    finally:
        bucket.rm("/written", recursive=True)


def test_what_is_not_a_finished_store_of_this_version_is_refused(finished, copy, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.zarr: there is no Zarr v3 group; run the stage"):
        Numbers.open(tmp_path / "nothing.zarr")
    with pytest.raises(FileNotFoundError, match="there is no Zarr v3 group"):
        Numbers.open("memory://bucket/nothing.zarr")
    with pytest.raises(ValueError, match=r"expected a store of format 'test\.others', got 'test\.numbers'"):
        Others.open(finished)
    with pytest.raises(ValueError, match=r"expected version 4 of test\.numbers, got version 3 .* run `dvc repro`"):
        Later.open(finished)
    with pytest.raises(ValueError, match=r"part-00000\.zip: expected the folder of a store, got a file; unpack"):
        Numbers.open(finished / "part-00000.zip")
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


@pytest.mark.parametrize("value", [{"a": 1}, 0, 1.5, "2", None])
def test_a_header_with_a_valid_checksum_and_absurd_values_is_refused(copy, value):
    content = json.loads((copy / "zarr.json").read_text())
    header = {key: entry for key, entry in content["attributes"].items() if key != "checksum"}
    signed = parts_module._signed({**header, "sequences_per_part": value})
    (copy / "zarr.json").write_text(json.dumps({**content, "attributes": signed}))
    with pytest.raises(ValueError, match=r"copy\.zarr: the attributes in zarr\.json are not those of a store"):
        Numbers.open(copy)


def test_a_part_that_lacks_a_sequence_of_the_header_is_refused(copy):
    store = Numbers.open(copy)
    store.parts["part-00002"] = ["s4", "s5"]
    with pytest.raises(ValueError, match=r"part-00002\.zip is unreadable: 's5'"):
        store.record("s4")


def test_a_version_with_a_line_break_is_refused_in_one_line(copy):
    content = json.loads((copy / "zarr.json").read_text())
    content["attributes"]["version"] = "a\nb"
    (copy / "zarr.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"expected version .* got version 'a\\nb'") as refused:
        Numbers.open(copy)
    assert "\n" not in str(refused.value)
