"""Labels of events in the store and in exported files: they follow their events, and cost nothing where none are."""

import dataclasses
import json
import zipfile
from pathlib import Path

import h5py
import pytest
import torch
from part_fixtures import group_to_change

from polarnet.events.labels import LABELS
from polarnet.recordings.recording import read_recording
from polarnet.storage.events import EventStore
from polarnet.storage.exchange import export_store

HEIGHT, WIDTH, DURATION_US = 12, 18, 90_500


@pytest.fixture(scope="module")
def channels(make_random_events):
    """Events whose label is their row modulo 4."""
    events = [make_random_events(k, 400 * k, DURATION_US, HEIGHT, WIDTH) for k in range(4)]
    return [dataclasses.replace(one, label=(one.y % 4).to(torch.uint8)) for one in events]


def write(path: Path, channels, labelled: bool) -> EventStore:
    store = EventStore.create(path, ["lake"], HEIGHT, WIDTH, {}, labelled=labelled)
    store.write("lake", channels, DURATION_US)
    store.finish()
    return EventStore.open(path)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory, channels) -> EventStore:
    return write(tmp_path_factory.mktemp("labels") / "events.zarr", channels, True)


@pytest.mark.parametrize(("start_us", "stop_us"), [(None, None), (20_000, 50_001)])
def test_labels_come_back_with_their_events(labelled, start_us, stop_us):
    for events in labelled.read("lake", start_us, stop_us):
        assert torch.equal(events.label, (events.y % 4).to(torch.uint8))
    assert sum(len(events) for events in labelled.read("lake")) == 2400
    assert EventStore.verify(labelled.path) == []
    assert labelled.header["conventions"]["events/label"] == "cause of an event: 0 signal, 1 leak, 2 shot, 3 hot"


def test_a_store_without_labels_has_the_same_bytes_whether_its_events_had_labels_or_not(labelled, channels, tmp_path):
    plain = [dataclasses.replace(events, label=None) for events in channels]
    for name, events in (("one", plain), ("two", channels)):
        assert write(tmp_path / name, events, False).read("lake")[3].label is None
    assert (tmp_path / "one/part-00000.zip").read_bytes() == (tmp_path / "two/part-00000.zip").read_bytes()
    with (
        zipfile.ZipFile(tmp_path / "one/part-00000.zip") as without,
        zipfile.ZipFile(Path(labelled.path, "part-00000.zip")) as having,
    ):
        more = set(having.namelist()) - set(without.namelist())
        assert more == {"events/label/zarr.json", "events/label/c/0"}
        assert all(having.read(name) == without.read(name) for name in without.namelist())


def test_a_labelled_store_takes_no_events_without_labels(channels, tmp_path):
    store = EventStore.create(tmp_path / "events.zarr", ["lake"], HEIGHT, WIDTH, {}, labelled=True)
    with pytest.raises(ValueError, match="polarizer 90: expected events with labels in a labelled store, got none"):
        store.write("lake", [*channels[:2], dataclasses.replace(channels[2], label=None), channels[3]], DURATION_US)
    wrong = dataclasses.replace(channels[1], label=channels[1].label + 4)
    with pytest.raises(ValueError, match="polarizer 45: expected labels from 0 to 3, got 7"):
        store.write("lake", [channels[0], wrong, *channels[2:]], DURATION_US)


def test_verify_names_a_label_that_a_foreign_writer_got_wrong(channels, tmp_path):
    store = write(tmp_path / "events.zarr", channels, True)
    with group_to_change(tmp_path / "events.zarr" / "part-00000.zip") as part:
        part["events/label"][1300] = 4
    assert EventStore.verify(store.path) == [f"{store.path}: lake, polarizer 135: expected labels from 0 to 3, got 4"]


def test_labels_are_exported_beside_events_that_read_as_before(labelled, tmp_path):
    for form, suffix in (("hdf5", ".h5"), ("text", ".txt")):
        export_store(labelled, tmp_path / form, form)
        for angle, events in zip(("000", "045", "090", "135"), labelled.read("lake"), strict=True):
            file = tmp_path / form / "lake" / f"polarizer_{angle}{suffix}"
            assert torch.equal(read_recording(file).events.t, events.t)
            if form == "hdf5":
                with h5py.File(file) as content:
                    assert content["events/label"][:].tolist() == events.label.tolist()
            else:
                lines = file.with_name(f"polarizer_{angle}_label.txt").read_text().split()
                assert list(map(int, lines)) == events.label.tolist()
        assert json.loads((tmp_path / form / "store.json").read_text())["labels"] == list(LABELS)
