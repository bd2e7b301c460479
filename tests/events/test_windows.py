"""Windows of sequences, and the data set of them."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader

from polarnet.events.representations import event_tensor, voxel_grid_of_window
from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import cut_windows, encode_windows, windows_of
from polarnet.storage.events import EventStore
from polarnet.storage.frames import Contents, FrameStore
from polarnet.training.engine.sequences import WindowDataset

HEIGHT, WIDTH = 4, 6
T_US = torch.tensor([0, 33_333, 66_667, 100_000])


@pytest.fixture(scope="module")
def stores(tmp_path_factory, make_random_events):
    folder = tmp_path_factory.mktemp("windows")
    events = EventStore.create(folder / "events.zarr", ["a", "b"], HEIGHT, WIDTH, {})
    frames = FrameStore.create(folder / "frames.zarr", Contents({"a": "train", "b": "test"}), len(T_US), HEIGHT, WIDTH)
    for i, name in enumerate(["a", "b"]):
        events.write(name, [make_random_events(10 * i + k, 500, 100_000, HEIGHT, WIDTH) for k in range(4)], 100_000)
        truth = torch.rand(len(T_US), 6, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(i))
        frames.write(name, T_US, truth[:, :4], truth[:, 4], truth[:, 5])
    events.finish()
    frames.finish()
    return EventStore.open(folder / "events.zarr"), FrameStore.open(folder / "frames.zarr")


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 100), max_size=40), st.sets(st.integers(0, 100), min_size=2, max_size=6))
def test_windows_share_out_all_events_from_the_first_frame_to_before_the_last(times, edges):
    t = torch.tensor(sorted(times), dtype=torch.int64)
    zero = torch.zeros(len(t))
    events = Events(t, zero.short(), zero.short(), (zero + 1).to(torch.int8), 1, 1)
    edges_us = torch.tensor(sorted(edges))
    parts = cut_windows(events, edges_us)
    inside = slice_time(events, int(edges_us[0]), int(edges_us[-1]))
    assert torch.cat([part.t for part in parts]).tolist() == inside.t.tolist()


def test_an_item_is_a_whole_sequence_with_the_truth_at_each_windows_end(stores):
    events, frames = stores
    item = WindowDataset(events, frames, ["b", "a"], event_tensor)[0]
    assert item.name == "b"
    assert item.inputs.shape == (3, 4, HEIGHT, WIDTH)
    assert torch.equal(item.dolp, frames.frames("b", 1).dolp)
    assert torch.equal(item.aolp, frames.frames("b", 1).aolp)
    assert torch.equal(item.intensity, frames.frames("b", 1).intensity)


def test_inputs_are_the_representation_of_each_window_of_each_polarizer(stores):
    events, frames = stores
    item = WindowDataset(events, frames, ["a"], event_tensor)[0]
    for k, (start, stop) in enumerate(windows_of(T_US)):
        for c, channel in enumerate(events.read("a")):
            assert torch.equal(item.inputs[k, c], event_tensor(slice_time(channel, start, stop), stop - start))


def test_several_channels_of_a_representation_stay_together_polarizer_by_polarizer(stores):
    events, _ = stores
    channels = events.read("a")
    inputs = encode_windows(channels, T_US, voxel_grid_of_window)
    assert inputs.shape == (3, 20, HEIGHT, WIDTH)
    assert torch.equal(inputs[1, 5:10], voxel_grid_of_window(cut_windows(channels[1], T_US)[1], 33_334))


def test_worker_processes_load_the_same_items(stores):
    dataset = WindowDataset(*stores, ["a", "b"], event_tensor)
    loaded = list(DataLoader(dataset, batch_size=None, num_workers=1))
    assert [item.name for item in loaded] == ["a", "b"]
    assert all(torch.equal(item.inputs, dataset[i].inputs) for i, item in enumerate(loaded))


def test_sequences_that_one_store_lacks_are_refused(stores):
    with pytest.raises(ValueError, match="c: not both in"):
        WindowDataset(*stores, ["a", "c"], event_tensor)


def test_stores_of_different_sensors_are_refused(stores, tmp_path, make_random_events):
    small = EventStore.create(tmp_path / "small.zarr", ["a"], 2, 3, {})
    small.write("a", [make_random_events(k, 10, 100, 2, 3) for k in range(4)], 100)
    small.finish()
    with pytest.raises(ValueError, match="events are 2x3 px"):
        WindowDataset(EventStore.open(tmp_path / "small.zarr"), stores[1], ["a"], event_tensor)


def test_two_frame_times_a_microsecond_apart_make_one_window_and_equal_ones_none():
    assert encode_windows([Events.empty(2, 3)], torch.tensor([5, 6]), event_tensor).shape == (1, 1, 2, 3)
    for times in ([5, 5], [5, 6, 6], [5]):
        with pytest.raises(ValueError, match="at least two frame times, each later than the last"):
            encode_windows([Events.empty(2, 3)], torch.tensor(times), event_tensor)
