"""The protocol that all stores share: make, resume, finish, open, and survive being killed."""

import errno
import functools
import gc
import json
import os
import pickle
import shutil
import signal
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from pathlib import Path

import fsspec
import numpy as np
import pytest
from part_fixtures import files_of, flip

import polarnet.storage.groups as groups_module
import polarnet.storage.parts as parts_module
from polarnet.storage.parts import Store

NAMES = [f"s{i}" for i in range(5)]
SEQUENCES_PER_PART = 2


class Numbers(Store):
    """Ragged numbers and pairs, by 1024 rows a chunk."""

    FORMAT = "test.numbers"
    VERSION = 3
    chunk = 1024


class Others(Numbers):
    FORMAT = "test.others"


class Later(Numbers):
    VERSION = 4


def store_at(path: str | Path, **attributes) -> Numbers:
    return Numbers.create_parts(path, NAMES, attributes, SEQUENCES_PER_PART)


def values_of(name: str) -> np.ndarray:
    number = NAMES.index(name)
    return np.random.default_rng(number).integers(0, 180, 3000 * number).astype(np.uint16)


def columns_of(name: str) -> dict[str, np.ndarray]:
    return {"value": values_of(name), "pair": np.stack([values_of(name)] * 2, axis=1).astype(np.int64)}


def write(store: Numbers, name: str) -> None:
    store.append(name, columns_of(name), {"number": NAMES.index(name)})


def write_missing_and_finish(path: str | Path) -> None:
    store = store_at(path)
    for name in store.missing():
        write(store, name)
    store.finish()


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
        for column, values in columns_of(name).items():
            assert np.array_equal(store.read_column(column, name), values)


def test_sequences_come_back_also_in_another_process_and_rows_count_within_them(finished):
    store = Numbers.open(finished)
    assert store.parts == {"part-00000": ["s0", "s1"], "part-00001": ["s2", "s3"], "part-00002": ["s4"]}
    assert_whole(store)
    assert_whole(pickle.loads(pickle.dumps(store)))
    with ProcessPoolExecutor(2, mp_context=get_context("fork")) as pool:
        assert [*pool.map(assert_whole, [store] * 8, timeout=60)] == [None] * 8
    store = Numbers.open(finished)
    assert np.array_equal(store.read_column("value", "s3", 2000, 5000), values_of("s3")[2000:5000])
    assert [len(store.read_column("value", name, 5990, 7000)) for name in ("s0", "s2")] == [0, 10]
    first, last = store.read_columns("s4", ["value", "pair"], [(0, 1), (11_999, None)])
    assert (first["pair"].tolist(), last["value"].tolist()) == ([[values_of("s4")[0]] * 2], [values_of("s4")[-1]])


def test_a_column_of_a_part_is_one_file_until_it_is_large(finished, tmp_path, monkeypatch):
    names = {*files_of(finished / "part-00001")}
    assert names == {"zarr.json", "value/zarr.json", "value/c/0", "pair/zarr.json", "pair/c/0/0"}
    monkeypatch.setattr(groups_module, "SHARD_BYTES", 4 * 1024 * 18)  # four chunks of rows of 18 bytes
    write_missing_and_finish(tmp_path / "store.zarr")
    assert_whole(Numbers.open(tmp_path / "store.zarr"))
    assert Numbers.verify(tmp_path / "store.zarr") == []
    assert sorted(os.listdir(tmp_path / "store.zarr" / "part-00001" / "value" / "c")) == ["0", "1", "2", "3"]


def test_the_order_of_the_parts_and_a_second_start_or_writer_leave_no_trace(finished, tmp_path):
    one, two = store_at(tmp_path / "store.zarr"), store_at(tmp_path / "store.zarr")
    write(one, "s2")  # begun, and begun again below
    for name in ["s4", "s2", "s3", "s0", "s1"]:
        write(one, name)
        write(two, name)
    two.finish()
    assert files_of(tmp_path / "store.zarr") == files_of(finished)


def test_a_disk_without_room_ends_the_writing_and_a_larger_one_takes_the_missing_parts(finished, tmp_path, monkeypatch):
    usage, free = shutil.disk_usage(tmp_path), 0
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=free))
    store = store_at(tmp_path / "store.zarr")
    write(store, "s0")
    with pytest.raises(OSError, match=r"zarr.tmp: the 2 missing parts need about 0\.\d MiB, the disk has 0\.0 MiB"):
        write(store, "s1")
    assert store.missing() == ["s2", "s3", "s4"]
    free = usage.free
    write_missing_and_finish(tmp_path / "store.zarr")
    assert files_of(tmp_path / "store.zarr") == files_of(finished)


def test_an_unfinished_store_is_resumed_under_an_equal_header_and_code_alone(finished, tmp_path, monkeypatch):
    path = tmp_path / "store.zarr"
    store = store_at(path, seed=1)
    with pytest.raises(ValueError, match="part-00001 takes its sequences in order, expected s2, got s3"):
        write(store, "s3")
    for name in ("s0", "s2", "s3", "s4"):  # the first part is begun only
        write(store, name)
    assert store_at(path, seed=1).missing_parts() == ["part-00000"]
    with pytest.raises(ValueError, match="2 not written yet: s0, s1; write them, then finish"):
        store_at(path, seed=1).finish()
    assert store_at(path, seed=2).missing() == NAMES
    assert Numbers.create_parts(path, NAMES, {"seed": 2}, 3).missing() == NAMES
    write(store_at(path), "s4")
    monkeypatch.setattr(parts_module, "code_digest", lambda: "of an edited polarnet")
    assert store_at(path).missing() == NAMES
    write_missing_and_finish(path)
    assert files_of(path) == files_of(finished)  # which do not name the code


def test_a_header_cannot_name_another_place_or_a_sequence_that_could_be_written_elsewhere(copy, tmp_path):
    content = json.loads((copy / "zarr.json").read_text())
    header = content["attributes"] | {"path": str(tmp_path)}
    (copy / "zarr.json").write_text(
        json.dumps(content | {"attributes": header | {"checksum": parts_module._checksum(header)}})
    )
    assert Numbers.open(copy).path == str(copy)
    for name in ("/tmp/outside", "../outside", "..", "a/b", "a\u202eb"):
        names = [*NAMES[:-1], name]
        checksum = parts_module._checksum({**header, "sequences": names})
        with pytest.raises(ValueError, match="expected a name without slashes and control characters"):
            Numbers.open(with_header(copy, sequences=names, checksum=checksum))
        with pytest.raises(ValueError, match="expected a name without slashes and control characters"):
            Numbers.create_parts(copy, [name], {}, 1)


def test_a_finished_store_replaces_the_one_that_was_there(tmp_path, copy):
    store = store_at(copy, seed=2)
    assert Numbers.open(copy).attributes == {}
    for name in NAMES:
        write(store, name)
    store.finish()
    assert Numbers.open(copy).attributes == {"seed": 2}
    assert [path.name for path in tmp_path.iterdir()] == ["copy.zarr"]


@pytest.mark.parametrize("lack", [OSError(errno.EMFILE, "Too many open files"), MemoryError()])
def test_a_lack_of_descriptors_or_memory_is_no_damage(finished, monkeypatch, lack):
    def refuse(_):
        raise lack

    store = Numbers.open(finished)
    monkeypatch.setattr(parts_module, "open_group", refuse)
    with pytest.raises(type(lack)) as refusal:
        store.record("s0")
    assert refusal.value is lack


class Killed(BaseException):
    """Stands for SIGKILL: zarr, which cleans up after an Exception, gets no chance to."""


@pytest.mark.thorough
def test_whichever_rename_a_writer_dies_before_the_rerun_ends_with_the_same_bytes(tmp_path, monkeypatch):
    """Zarr renames each file that it has written, so that these are the moments between any two files."""
    path, moves, deaths = tmp_path / "store.zarr", {"replace": os.replace, "rename": os.rename}, 0
    left = 10_000

    def move_or_die(name, source, target):
        nonlocal left
        left -= 1
        if left < 0:
            raise Killed
        moves[name](source, target)

    def write_two_parts():
        store = Numbers.create_parts(path, ["s0", "s1"], {}, 1)
        for name in store.missing():
            write(store, name)
        store.finish()

    for name in moves:
        monkeypatch.setattr(os, name, functools.partial(move_or_die, name))
    gc.freeze()  # so that each of many collections looks at the objects of this test alone
    write_two_parts()
    expected = files_of(path)
    for allowed in range(10_000 - left):
        shutil.rmtree(path)
        left = allowed
        with pytest.raises(Killed):
            write_two_parts()
        deaths += 1
        gc.collect()  # the claim on the path ends with the store
        left = 10_000
        write_two_parts()
        assert files_of(path) == expected
        assert [entry.name for entry in tmp_path.iterdir()] == ["store.zarr"]
    assert deaths > 6


def test_a_second_writer_is_refused_while_the_first_lives(tmp_path):
    path = tmp_path / "store.zarr"
    claimed, sender = Pipe(duplex=False)
    process = get_context("fork").Process(target=_claim, args=(path, sender))
    process.start()
    try:
        assert claimed.poll(60), "the process claims nothing"
        with pytest.raises(ValueError, match=r"store\.zarr: another process is writing it; wait until that has ended"):
            store_at(path)
    finally:
        process.kill()
        process.join()
    write_missing_and_finish(path)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["store.zarr"]


def _claim(path: Path, claimed: Connection) -> None:
    _store = store_at(path)
    claimed.send(True)
    signal.pause()


def test_every_flipped_bit_and_every_cut_or_missing_file_is_found_and_named(copy):
    for name, content in files_of(copy).items():
        file = copy / name
        for place in (0, 0.3, 0.5, 0.999):
            flip(file, place)
            assert name == "zarr.json" or f"{name} is not as it was written" in Numbers.verify(copy)[0]
            assert Numbers.verify(copy)
            file.write_bytes(content)
        for damaged in (content[:-3], b"", None):
            file.unlink() if damaged is None else file.write_bytes(damaged)
            assert Numbers.verify(copy)
            file.write_bytes(content)
    assert Numbers.verify(copy) == []


def test_a_reader_names_sequence_and_column_of_a_damaged_file(copy):
    shard, other = (copy / part / "value" / "c" / "0" for part in ("part-00001", "part-00000"))
    content = shard.read_bytes()
    flip(shard, 0.9)
    for damaged in (shard.read_bytes(), other.read_bytes(), content[:-3], b"", None, "pipe"):
        shard.unlink()
        if damaged == "pipe":
            os.mkfifo(shard)
        elif damaged is not None:
            shard.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"s3, column value of part-00001 is unreadable: .*write this store again"):
            Numbers.open(copy).read_column("value", "s3")
        assert "part-00001/value/c/0 is not as it was written" in Numbers.verify(copy)[0]
        shard.touch()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sequences_per_part": 0}, "sequences_per_part: expected > 0, got 0"),
        ({"sequences_per_part": "x"}, "sequences_per_part: expected a valid integer"),
        ({"attributes": None}, "attributes: expected a valid dictionary, got None"),
        ({"digests": {}}, "expected digests of 3 parts, got others"),
        ({"sequences": [*NAMES[:3], "\u00fc", "u\u0308"]}, "expected each name once"),
    ],
)
def test_a_header_that_no_writer_makes_is_refused_under_a_checksum_that_fits(copy, values, message):
    header = json.loads((copy / "zarr.json").read_text())["attributes"]
    with pytest.raises(ValueError, match=message):
        Numbers.open(with_header(copy, **values, checksum=parts_module._checksum({**header, **values})))


def test_a_part_of_another_place_or_another_store_is_an_error(copy, tmp_path):
    other = store_at(tmp_path / "other.zarr")
    for name in NAMES:
        other.append(name, {key: values[::-1] for key, values in columns_of(name).items()}, {"number": 0})
    other.finish()
    for foreign in (copy / "part-00001", tmp_path / "other.zarr" / "part-00000"):
        shutil.rmtree(copy / "part-00000")
        shutil.copytree(foreign, copy / "part-00000")
        with pytest.raises(ValueError, match=r"s0, part-00000 is unreadable: it is not the part that was written"):
            Numbers.open(copy).record("s0")
        (problem,) = Numbers.verify(copy)
        assert "part-00000/zarr.json is not as it was written; it holds s0, s1" in problem


def test_a_url_is_written_resumed_read_and_verified_like_a_folder(finished):
    bucket, url = fsspec.filesystem("memory"), "memory://written/store.zarr"
    try:
        killed = store_at(url)
        for name in killed.parts["part-00000"]:
            write(killed, name)
        before = bucket.modified("/written/store.zarr/part-00000/zarr.json")
        with pytest.raises(ValueError, match="the store was never finished"):
            Numbers.open(url)
        with pytest.raises(ValueError, match="expected nothing there, or this store unfinished, got another"):
            store_at(url, other=1)
        write_missing_and_finish(url)
        assert bucket.modified("/written/store.zarr/part-00000/zarr.json") == before
        for name, content in files_of(finished).items():
            assert bucket.cat(f"/written/store.zarr/{name}") == content
        for path in (url, finished.as_uri()):
            assert_whole(Numbers.open(path))
            assert Numbers.verify(path) == []
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
    with pytest.raises(ValueError, match=r"zarr\.json: expected the folder of a store, got a file; unpack"):
        Numbers.open(finished / "zarr.json")
    with pytest.raises(ValueError, match=r"attributes in zarr\.json are not what was written"):
        Numbers.open(with_header(copy, sequences=[*NAMES[:-1], "s7"]))
    with pytest.raises(ValueError, match=r"expected version .* got version 'a\\nb'") as refused:
        Numbers.open(with_header(copy, version="a\nb"))
    assert "\n" not in str(refused.value)
    for content in ("6", "[]", "{"):
        (copy / "zarr.json").write_text(content)
        with pytest.raises(ValueError, match=r"copy\.zarr is unreadable"):
            Numbers.open(copy)
    store_at(tmp_path / "begun.zarr")
    with pytest.raises(FileNotFoundError, match=r"begun\.zarr\.tmp is unfinished"):
        Numbers.open(tmp_path / "begun.zarr")


def with_header(path: Path, **values) -> Path:
    """The store with other values in its header."""
    content = json.loads((path / "zarr.json").read_text())
    content["attributes"].update(values)
    (path / "zarr.json").write_text(json.dumps(content))
    return path


def test_what_cannot_be_a_store_is_refused(finished, tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        store_at(tmp_path / "store.zarr", threshold=float("nan"))
    with pytest.raises(ValueError, match="expected each name once, got a again"):
        Numbers.create_parts(tmp_path / "store.zarr", ["a", "b", "a"], {}, 1)
    with pytest.raises(ValueError, match=r"expected a sequence of s0, s1, s2, s3, s4; got 's9'"):
        Numbers.open(finished).record("s9")
