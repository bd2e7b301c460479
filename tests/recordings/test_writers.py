"""Files for other tools: the readers of recordings get back what went out."""

import subprocess
import sys

import h5py
import numpy as np
import pytest
import torch

from polarnet.events.stream import slice_count
from polarnet.recordings.recording import read_recording
from polarnet.recordings.writers import export_store, write_evt3, write_hdf5, write_text
from polarnet.storage.events import EventStore

HEIGHT, WIDTH = 12, 18


@pytest.fixture(scope="module")
def store(tmp_path_factory, make_random_events) -> EventStore:
    path = tmp_path_factory.mktemp("exchange") / "events.zarr"
    store = EventStore.create(path, ["b", "a"], HEIGHT, WIDTH, {"seed": 1}, 2)
    for i, name in enumerate(["b", "a"]):
        store.write(name, [make_random_events(4 * i + k, 300 * k, 90_500, HEIGHT, WIDTH) for k in range(4)], 90_500)
    store.finish()
    return EventStore.open(path)


@pytest.mark.parametrize(("form", "suffix"), [("hdf5", "h5"), ("text", "txt"), ("evt3", "raw")])
def test_an_exported_store_reads_back_as_recordings(store, tmp_path, form, suffix):
    export_store(store, str(tmp_path / "files"), form)
    for name in store.sequences:
        files = sorted((tmp_path / "files" / name).iterdir())
        assert [file.name for file in files] == [f"polarizer_{a}.{suffix}" for a in ("000", "045", "090", "135")]
        for file, events in zip(files, store.read(name), strict=True):
            read = read_recording(file).events
            assert all(torch.equal(getattr(read, column), getattr(events, column)) for column in "txyp")
            assert (read.height, read.width) == (HEIGHT, WIDTH)


def test_hdf5_has_dsecs_names_and_types_and_text_is_what_e2vid_reads(make_events, tmp_path):
    """DSEC: t[ms_to_idx[k]] >= 1000 k > t[ms_to_idx[k] - 1]; polarity 0 or 1."""
    events = make_events([(0, 1, 2, 1), (999, 3, 4, -1), (1000, 5, 6, 1), (2500, 7, 8, -1)], HEIGHT, WIDTH)
    write_hdf5(tmp_path / "e.h5", events)
    with h5py.File(tmp_path / "e.h5") as file:
        assert {name: file[f"events/{name}"].dtype.name for name in "xytp"} == {
            "x": "uint16",
            "y": "uint16",
            "t": "int64",
            "p": "uint8",
        }
        assert file["events/p"][:].tolist() == [1, 0, 1, 0]
        assert file["ms_to_idx"][:].tolist() == [0, 2, 3, 4]
        assert file["t_offset"][()] == 0
    write_text(tmp_path / "e.txt", make_events([(5, 1, 2, 1), (1_000_001, 3, 4, -1)], HEIGHT, WIDTH))
    assert (tmp_path / "e.txt").read_text() == "18 12\n0.000005 1 2 1\n1.000001 3 4 0\n"


def test_evt3_words_are_time_row_and_column_and_silence_keeps_the_clock_running(make_events, tmp_path):
    """Prophesee: 0x8 high time, 0x6 low time, 0x0 row, 0x2 polarity and column; the 24 bits wrap every 16.8 s."""
    rows = [(5, 1, 2, 1), (5, 3, 2, -1), (2**25 + 7, 17, 11, 1)]
    write_evt3(tmp_path / "e.raw", make_events(rows, HEIGHT, WIDTH))
    header, _, words = (tmp_path / "e.raw").read_bytes().partition(b"% end\n")
    words = np.frombuffer(words, "<u2")
    assert b"% geometry 18x12" in header
    assert words[:5].tolist() == [0x8000, 0x6005, 0x0002, 0x2801, 0x2003]
    assert words[-4:].tolist() == [0x8000, 0x6007, 0x000B, 0x2811]
    assert len(words) == 5 + 2**13 + 3
    assert read_recording(tmp_path / "e.raw").events.t.tolist() == [5, 5, 2**25 + 7]


@pytest.mark.parametrize("write", [write_hdf5, write_text, write_evt3])
def test_chunks_of_a_recording_of_100_minutes_give_the_file_of_the_whole(write, make_events, tmp_path):
    times = [0, 1500, 2 * 10**9, 2**32 - 1, 2**32, 6 * 10**9]
    events = make_events([(t, 3, k, 1 - k % 2 * 2) for k, t in enumerate(times)], HEIGHT, WIDTH)
    chunks = (slice_count(events, start, stop) for start, stop in ((0, 0), (0, 2), (2, 2), (2, 6)))
    write(tmp_path / "whole", events)
    write(tmp_path / "chunks", chunks)
    for name in ("whole", "chunks"):
        read = read_recording(tmp_path / name).events
        assert all(torch.equal(getattr(read, column), getattr(events, column)) for column in "txyp")
    if write is write_hdf5:
        with h5py.File(tmp_path / "whole") as whole, h5py.File(tmp_path / "chunks") as other:
            assert np.array_equal(whole["ms_to_idx"], other["ms_to_idx"])
            assert whole["ms_to_idx"][-1] == len(times)
    else:
        assert (tmp_path / "whole").read_bytes() == (tmp_path / "chunks").read_bytes()


@pytest.mark.parametrize(("write", "times"), [
    (write_hdf5, [-1]), (write_text, [-1]), (write_evt3, [-1, 0]), (write_hdf5, [0, 10**13]), (write_evt3, [10**13]),
    (write_text, [5, 4]),
])  # fmt: skip
def test_times_that_a_format_cannot_hold_are_refused(write, times, make_events, tmp_path):
    chunks = [make_events([(t, 1, 1, 1)], HEIGHT, WIDTH) for t in times]
    with pytest.raises(ValueError, match="holds times from 0 to"):
        write(tmp_path / "e", chunks)


def test_a_sensor_that_evt3_cannot_count_and_an_unknown_form_are_refused(make_events, tmp_path, store):
    with pytest.raises(ValueError, match="up to 2048 px a side, got 4x2049"):
        write_evt3(tmp_path / "e.raw", make_events([], 4, 2049))
    with pytest.raises(ValueError, match="expected a form of hdf5, text, evt3, got 'aedat'"):
        export_store(store, tmp_path, "aedat")


def test_without_h5py_the_error_names_the_extra(make_events, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(RuntimeError, match=r"run pip install -e '\.\[recordings\]' in the clone"):
        write_hdf5(tmp_path / "e.h5", make_events([], 1, 1))


@pytest.mark.thorough
def test_hdf5_on_a_full_disk_ends_with_the_error_of_the_disk_and_the_process_goes_on(tmp_path):
    """HDF5 itself crashes then, once its objects are released."""
    script = f"""
import resource, torch
from polarnet.events.stream import Events
from polarnet.recordings.writers import write_hdf5
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
t = torch.arange(200_000)
events = Events(t, (t % 346).short(), (t % 260).short(), torch.ones(200_000, dtype=torch.int8), 260, 346)
try:
    write_hdf5({str(tmp_path / "e.h5")!r}, events)
except OSError as error:
    print(error)
del events
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "[Errno 27] File too large\n", "")
