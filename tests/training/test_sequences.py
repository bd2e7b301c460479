import itertools
import math

import pytest
import torch

from polarnet import stokes
from polarnet.events.representations import event_tensor
from polarnet.events.stream import slice_time
from polarnet.runtime.machine import generator_for
from polarnet.storage import EventStore, FrameStore
from polarnet.training.engine.sequences import (
    MEMORY_SHARE,
    View,
    ViewConfig,
    Visits,
    WindowDataset,
    Windows,
    apply_view,
    batches_of,
    loaded_if_it_fits,
    packed,
    random_view,
    stack,
)


def sequence(name: str = "s", windows: int = 3, height: int = 6, width: int = 8) -> Windows:
    """Truth that is exact: intensities follow from S0, DoLP and AoLP, and the inputs are the intensities twice over."""
    torch.manual_seed(len(name))
    s0, dolp, fraction = torch.rand(3, windows, height, width)
    aolp = math.pi * fraction
    intensity = stokes.intensities_from_stokes(stokes.stokes_from_polarization(s0, dolp, aolp))
    return Windows([name], intensity.repeat_interleave(2, dim=1), dolp, aolp, intensity)


WHOLE = View(slice(0, 3), slice(0, 6), slice(0, 8), mirrored=(), turn=0, direction=1)
PLAIN = ViewConfig(visits=1, windows=None, crop=None, symmetries=False)


@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize("direction", [1, -1])
def test_renumbered_polarizers_still_obey_the_stokes_equations(turn, direction):
    before = sequence()
    after = apply_view(before, WHOLE._replace(turn=turn, direction=direction))
    vector = stokes.stokes_from_intensities(after.intensity)
    torch.testing.assert_close(stokes.dolp(vector), before.dolp, atol=1e-4, rtol=1e-4)
    difference = torch.remainder(stokes.aolp(vector) - after.aolp + math.pi / 2, math.pi) - math.pi / 2
    assert (difference.abs() * before.dolp).max() < 1e-4
    assert torch.equal(after.inputs, after.intensity.repeat_interleave(2, dim=1))


def test_a_view_is_the_same_part_of_inputs_and_truth():
    before = sequence()
    after = apply_view(before, View(slice(1, 3), slice(2, 6), slice(3, 8), (-1,), turn=0, direction=1))
    for name in ("inputs", "dolp", "aolp", "intensity"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name)[1:3, ..., 2:6, 3:8].flip(-1))


def test_a_random_view_is_drawn_from_its_generator_and_stays_inside():
    config = ViewConfig(visits=1, windows=2, crop=[16, 17], symmetries=True)
    for visit in range(50):
        view = random_view(5, 20, 30, config, generator_for(1, "s", str(visit)))
        assert view == random_view(5, 20, 30, config, generator_for(1, "s", str(visit)))
        for part, size, whole in ((view.windows, 2, 5), (view.rows, 16, 20), (view.columns, 17, 30)):
            assert part.stop - part.start == size
            assert 0 <= part.start <= whole - size
    assert random_view(3, 6, 8, PLAIN, generator_for(1, "s", "0")) == WHOLE


def test_an_epoch_visits_each_sequence_as_often_as_it_should_under_other_views():
    config = ViewConfig(visits=3, windows=1, crop=None, symmetries=True)
    visits = Visits([sequence("a"), sequence("bb")], config, seed=1, epoch=0)
    views = [visits[index] for index in range(len(visits))]
    assert sorted(name for one in views for name in one.names) == ["a", "a", "a", "bb", "bb", "bb"]
    firsts = [one.inputs for one in views if one.names == ["a"]]
    assert not torch.equal(firsts[0], firsts[1])
    assert torch.equal(visits[0].inputs, visits[0].inputs)


def test_an_item_is_a_whole_sequence_with_the_truth_at_each_windows_end(stores):
    events, frames = EventStore.open(stores[0]), FrameStore.open(stores[1])
    item = WindowDataset(events, frames, ["b", "a"], event_tensor)[0]
    assert item.names == ["b"]
    t_us, intensity, dolp, aolp, _ = frames.frames("b")
    for k, (start, stop) in enumerate(itertools.pairwise(t_us.tolist())):
        for c, channel in enumerate(events.read("b")):
            assert torch.equal(item.inputs[k, c], event_tensor(slice_time(channel, start, stop), stop - start))
    for own, truth in ((item.dolp, dolp), (item.aolp, aolp), (item.intensity, intensity)):
        assert torch.equal(own, truth[1:])


@pytest.mark.parametrize("workers", [1, 2])
def test_a_dataset_in_memory_is_read_once_by_this_process_or_by_workers(stores, workers):
    dataset = WindowDataset(EventStore.open(stores[0]), FrameStore.open(stores[1]), ["a", "b"], event_tensor)
    loaded = loaded_if_it_fits(dataset, intensity=True, workers=workers)
    assert [one.names for one in loaded] == [["a"], ["b"]]
    assert loaded[1] is loaded[1]
    assert torch.equal(loaded[1].inputs, dataset[1].inputs)
    assert not any(one.inputs.is_shared() for one in loaded)


def test_a_dataset_is_kept_in_memory_only_if_a_share_of_it_is_enough(stores, monkeypatch):
    dataset = WindowDataset(EventStore.open(stores[0]), FrameStore.open(stores[1]), ["a", "b"], event_tensor)
    needed = 2 * sum(tensor.nbytes for tensor in packed(dataset[0], True)[1:] if tensor is not None)
    for share, fits in ((1.01, True), (0.99, False)):
        free = int(share * needed / MEMORY_SHARE)
        monkeypatch.setattr("polarnet.training.engine.sequences.memory", lambda free=free: (free, free))
        assert (loaded_if_it_fits(dataset, intensity=True, workers=1) is not None) == fits


def test_counts_of_events_are_kept_as_bytes_and_seen_as_they_were():
    counts = sequence()._replace(inputs=torch.randint(-128, 128, (3, 8, 6, 8)).float())
    compact = packed(counts, intensity=True)
    assert compact.inputs.dtype == torch.int8
    inputs = apply_view(compact, WHOLE).inputs
    assert inputs.dtype == torch.int8
    assert torch.equal(inputs.float(), counts.inputs)

    less = stack([apply_view(packed(sequence(), intensity=False), WHOLE)] * 2)
    assert less.intensity.numel() == 0
    assert torch.equal(less.dolp[:, 1], sequence().dolp)
    for value in (0.5, 128.0, -129.0, 1e9):  # which bytes do not hold
        before = sequence()._replace(inputs=torch.full((3, 8, 6, 8), value))
        assert packed(before, intensity=True) is before


def test_a_crop_a_batch_and_stores_that_do_not_fit_are_refused(stores, tmp_path):
    config = ViewConfig(visits=1, windows=None, crop=[16, 16], symmetries=True)
    with pytest.raises(ValueError, match="at most the 3 windows of 6x8 pixels of the sequences, got 3 of 16x16"):
        random_view(3, 6, 8, config, generator_for(1, "s", "0"))

    with pytest.raises(ValueError, match=r"equally many windows, got \[3, 4\]; use batch_size=1"):
        stack([sequence(windows=3), sequence(windows=4)])
    frames = FrameStore.open(stores[1])
    with pytest.raises(ValueError, match="f: not both in"):
        WindowDataset(EventStore.open(stores[0]), frames, ["a", "f"], event_tensor)
    small = EventStore.create(tmp_path / "small.zarr", ["a"], 2, 3, {})
    with pytest.raises(ValueError, match="events are 2x3 px"):
        WindowDataset(small, frames, ["a"], event_tensor)


def test_the_order_is_a_permutation_and_batches_follow_it_with_a_small_last_one():
    def shuffled(seed: int, epoch: int) -> list[int]:
        return Visits([sequence()] * 9, PLAIN, seed, epoch).order()

    assert sorted(shuffled(seed=1, epoch=0)) == list(range(9))
    assert shuffled(seed=1, epoch=0) == shuffled(seed=1, epoch=0)
    assert len({tuple(shuffled(seed, epoch)) for seed in (1, 2) for epoch in (0, 1)}) == 4
    dataset = Visits([sequence("a"), sequence("bb"), sequence("ccc")], PLAIN, seed=1, epoch=0)
    names = [batch.names for batch in batches_of(dataset, [2, 0, 1], batch_size=2, workers=0)]
    assert names == [["ccc", "a"], ["bb"]]


def test_a_mask_is_cropped_mirrored_and_stacked_with_its_truth():
    masked = [s._replace(valid=s.dolp > 0.3) for s in (sequence("a"), sequence("bb"))]
    after = apply_view(masked[0], View(slice(0, 3), slice(1, 5), slice(0, 8), (-1, -2), turn=3, direction=-1))
    assert torch.equal(after.valid, after.dolp > 0.3)
    batch = stack(masked)
    assert torch.equal(batch.valid, batch.dolp > 0.3)
    assert batch.names == ["a", "bb"]
    assert batch.inputs.shape == (3, 2, 8, 6, 8)
    assert stack([sequence("a"), sequence("bb")]).valid is None
