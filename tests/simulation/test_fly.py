"""Events made in memory are those that the emulate stage stores."""

import pickle

import pytest
from event_fixtures import equal

from polarnet.simulation import dataset as fly
from polarnet.simulation.dataset import EmulatedEvents
from polarnet.storage.events import EventStore
from polarnet.storage.scenes import SceneStore


@pytest.fixture
def emulated(simulated) -> list[str]:
    """Names of the sequences that were emulated since the test began."""
    return []


@pytest.fixture
def source(simulated, emulated, monkeypatch) -> EmulatedEvents:
    def counted(scenes, sequence, *arguments):
        emulated.append(sequence)
        return emulate_sequence(scenes, sequence, *arguments)

    emulate_sequence = fly.emulate_sequence
    monkeypatch.setattr(fly, "emulate_sequence", counted)
    return EmulatedEvents(SceneStore.open(simulated.scenes), simulated.camera, simulated.seed, capacity=2)


def all_equal(some, others) -> bool:
    return all(equal(a, b) and a.t.dtype == b.t.dtype for a, b in zip(some, others, strict=True))


WINDOWS = [(None, None), (0, 33_333), (33_333, 66_667), (190_000, None), (None, 1), (-5, 10_000), (90_000, 20_000)]


@pytest.mark.parametrize(("start_us", "stop_us"), WINDOWS)
def test_every_window_holds_the_stored_events_whoever_is_asked(simulated, source, start_us, stop_us):
    store = EventStore.open(simulated.events)
    assert (source.sequences, source.height, source.width) == (store.sequences, store.height, store.width)
    assert source.attributes == store.attributes
    for name in store.sequences:
        assert all_equal(source.read(name, start_us, stop_us), store.read(name, start_us, stop_us)), name
    assert sum(store.count("a-0")) > 1000  # there is something to compare


def test_a_sequence_is_emulated_once_for_all_its_windows_and_forgotten_after_two_others(source, emulated):
    source.read("a-0", 0, 50_000)
    source.read("a-0", 50_000, 90_000)
    source.read("b-0")
    source.read("a-0")
    assert emulated == ["a-0", "b-0"]
    source.read("c-0")  # b was asked for longest ago
    source.read("a-0")
    source.read("b-0")
    assert emulated == ["a-0", "b-0", "c-0", "b-0"]


def test_a_copy_in_another_process_takes_no_events_along(source):
    fresh = len(pickle.dumps(source))
    events = source.read("a-0")
    assert len(pickle.dumps(source)) < fresh + 0.1 * sum(channel.t.nbytes for channel in events)
    assert all_equal(pickle.loads(pickle.dumps(source)).read("a-0"), events)


def test_an_unknown_sequence_is_refused(source):
    with pytest.raises(ValueError, match="expected a sequence of a-0, b-0, c-0, d-0; got 'lake'"):
        source.read("lake")
