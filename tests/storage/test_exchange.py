"""Other tools' files: what goes out comes back."""

import hashlib
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from polarnet.storage.events import EventStore
from polarnet.storage.exchange import (
    export_store,
    import_store,
    read_hdf5,
    read_text,
    write_hdf5,
    write_text,
)

HEIGHT, WIDTH = 12, 18


@pytest.fixture(scope="module")
def store(tmp_path_factory, make_random_events) -> EventStore:
    path = tmp_path_factory.mktemp("exchange") / "events.zarr"
    store = EventStore.create(path, ["b", "a"], HEIGHT, WIDTH, {"seed": 1}, 2)
    for i, name in enumerate(["b", "a"]):
        store.write(name, [make_random_events(4 * i + k, 300 * k, 90_500, HEIGHT, WIDTH) for k in range(4)], 90_500)
    store.finish()
    return EventStore.open(path)


@pytest.mark.parametrize("form", ["hdf5", "text"])
def test_a_store_survives_the_round_trip_to_the_byte(store, tmp_path, form):
    export_store(store, tmp_path / "files", form)
    import_store(tmp_path / "files", tmp_path / "again.zarr")
    assert _digest(tmp_path / "again.zarr") == _digest(store.path)
    suffix = {"hdf5": "h5", "text": "txt"}[form]
    assert [path.name for path in sorted((tmp_path / "files" / "a").iterdir())] == [
        f"polarizer_{angle}.{suffix}" for angle in ("000", "045", "090", "135")
    ]


def _digest(folder) -> dict[str, str]:
    files = sorted(file for file in Path(folder).rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def test_hdf5_has_dsecs_names_and_types(make_events, tmp_path):
    """DSEC: t[ms_to_idx[k]] >= 1000 k > t[ms_to_idx[k] - 1]; polarity 0 or 1."""
    events = make_events([(0, 1, 2, 1), (999, 3, 4, -1), (1000, 5, 6, 1), (2500, 7, 8, -1)], HEIGHT, WIDTH)
    write_hdf5(tmp_path / "e.h5", events, 3000)
    with h5py.File(tmp_path / "e.h5") as file:
        assert {name: file[f"events/{name}"].dtype.name for name in "xytp"} == {
            "x": "uint16",
            "y": "uint16",
            "t": "uint32",
            "p": "uint8",
        }
        assert file["events/p"][:].tolist() == [1, 0, 1, 0]
        assert file["ms_to_idx"][:].tolist() == [0, 2, 3, 4]
        assert file["t_offset"][()] == 0


def test_a_file_of_dsec_itself_is_read_at_its_offset(tmp_path):
    with h5py.File(tmp_path / "dsec.h5", "w") as file:
        for name, values, dtype in (
            ("x", [639, 0], "uint16"),
            ("y", [479, 0], "uint16"),
            ("t", [3, 9], "uint32"),
            ("p", [1, 0], "uint8"),
        ):
            file[f"events/{name}"] = np.array(values, dtype)
        file["t_offset"] = np.int64(49_599_300_523)
    events = read_hdf5(tmp_path / "dsec.h5", height=480, width=640)
    assert events.t.tolist() == [49_599_300_526, 49_599_300_532]
    assert events.p.tolist() == [1, -1]
    with pytest.raises(ValueError, match=r"dsec\.h5: the file does not say how large the sensor is"):
        read_hdf5(tmp_path / "dsec.h5")


def test_an_hdf5_file_of_something_else_is_refused(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["events"] = np.zeros((3, 4))
    with pytest.raises(ValueError, match="expected DSEC's HDF5, there is no events/x"):
        read_hdf5(tmp_path / "other.h5")


def test_text_is_what_e2vid_reads(make_events, tmp_path):
    write_text(tmp_path / "e.txt", make_events([(5, 1, 2, 1), (1_000_001, 3, 4, -1)], HEIGHT, WIDTH), 2_000_000)
    assert (tmp_path / "e.txt").read_text() == "18 12\n0.000005 1 2 1\n1.000001 3 4 0\n"


def test_times_without_a_point_are_microseconds_and_minus_one_is_darker(tmp_path):
    (tmp_path / "e.txt").write_text("# t x y p\n5 1 2 1\n\n1000001 3 4 -1  # late\n")
    events = read_text(tmp_path / "e.txt", HEIGHT, WIDTH)
    assert events.t.tolist() == [5, 1_000_001]
    assert events.p.tolist() == [1, -1]


def test_seconds_since_1970_keep_their_microseconds(tmp_path):
    (tmp_path / "e.txt").write_text("18 12\n1468941032.229165 1 2 1\n1468941032.229166 1 2 0\n")
    assert read_text(tmp_path / "e.txt").t.tolist() == [1_468_941_032_229_165, 1_468_941_032_229_166]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3 1\n", "does not say how large the sensor is"),
        ("18 12\n1 2 3\n", "expected the four columns t x y p, got 3"),
        ("18 12\n1 2 3 1\n1 2 3\n", "expected lines 't x y p'"),
        ("18 12\n1 2 x 1\n", "expected lines 't x y p'"),
        ("18 12\n1 2 3 2\n", r"expected polarities 0 and 1, or -1 and 1, got \[2\.0\]"),
        ("18 12\n1 2 3 0\n2 2 3 -1\n", "expected polarities"),
        ("18 12\n1 2 12 1\n", "x=2, y=12 are not on a sensor of 12x18"),
        ("18 12\n2 2 3 1\n1 2 3 1\n", "event 1 of 2: expected a time no earlier"),
        ("18 12\n1 2.5 3 1\n", "x and y to be whole numbers"),
    ],
)
def test_text_that_is_no_event_stream_is_refused_by_name(tmp_path, text, message):
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(ValueError, match=rf"bad\.txt: .*{message}"):
        read_text(tmp_path / "bad.txt")


def test_a_text_file_without_events_is_an_empty_stream(tmp_path):
    (tmp_path / "e.txt").write_text("18 12\n")
    assert len(read_text(tmp_path / "e.txt")) == 0


def test_without_h5py_the_error_names_the_extra(make_events, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(RuntimeError, match=r"pip install 'polarnet\[hdf5\]'"):
        write_hdf5(tmp_path / "e.h5", make_events([], 1, 1), 1000)


def test_unknown_forms_and_foreign_folders_are_refused(store, tmp_path):
    with pytest.raises(ValueError, match="expected a form of hdf5, text, got 'aedat'"):
        export_store(store, tmp_path, "aedat")
    with pytest.raises(FileNotFoundError, match=r"has no store\.json"):
        import_store(tmp_path, tmp_path / "again.zarr")


def test_columns_of_a_file_keep_the_types_of_events(make_random_events, tmp_path):
    events = make_random_events(0, 100, 1000, HEIGHT, WIDTH)
    write_hdf5(tmp_path / "e.h5", events, 1000)
    assert all(torch.equal(getattr(read_hdf5(tmp_path / "e.h5"), c), getattr(events, c)) for c in "txyp")


@pytest.mark.parametrize("form", ["hdf5", "text"])
def test_paths_may_be_text(store, make_events, tmp_path, form):
    export_store(store, str(tmp_path / "files"), form)
    import_store(str(tmp_path / "files"), str(tmp_path / "again.zarr"))
    assert _digest(tmp_path / "again.zarr") == _digest(store.path)
    write, read = {"hdf5": (write_hdf5, read_hdf5), "text": (write_text, read_text)}[form]
    write(str(tmp_path / "e"), make_events([(5, 1, 2, 1)], 3, 4), 10)
    assert read(str(tmp_path / "e")).t.tolist() == [5]
