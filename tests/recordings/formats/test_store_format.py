import pytest
from part_fixtures import flip

from polarnet.recordings.formats import store as store_format
from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError
from polarnet.storage.events import EventStore


@pytest.fixture
def channels(make_random_events):
    return [make_random_events(k, 500 + 100 * k, 90_000, 12, 18) for k in range(4)]


@pytest.fixture
def store(tmp_path, channels):
    store = EventStore.create(tmp_path / "events.zarr", ["lake", "wood"], 12, 18, {})
    for name in store.sequences:
        store.write(name, channels, 90_500)
    store.finish()
    return tmp_path / "events.zarr"


@pytest.mark.parametrize(("angle", "channel"), [(0, 0), (135, 3)])
def test_a_channel_reads_back_equal(store, channels, same_events, monkeypatch, angle, channel):
    monkeypatch.setattr(store_format, "BLOCK_EVENTS", 64)
    recording = read_recording(store, part=f"wood/{angle}")
    assert recording.format == "store"
    assert same_events(recording.events, channels[channel])


@pytest.mark.parametrize("part", [None, "lake", "lake/44", "sea/45", "45"])
def test_the_parts_are_named_where_none_is_chosen(store, part):
    with pytest.raises(
        RecordingError, match=r"say which channel to read, --part with one of lake/0, lake/45, .* wood/135"
    ):
        read_recording(store, part=part)


def test_a_damaged_store_is_refused_with_the_sequence(store):
    flip(store / "part-00001" / "x" / "c" / "0")
    with pytest.raises(RecordingError, match="wood, column x of part-00001 is unreadable"):
        read_recording(store, part="wood/0")


def test_a_folder_of_something_else_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="of none of the formats"):
        read_recording(tmp_path)
