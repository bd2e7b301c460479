"""The event store: what is written comes back, a window reads little, and damage has a name."""

from pathlib import Path

import numpy as np
import pytest
import torch
import zarr
from event_fixtures import equal
from zarr.storage import LocalStore

import polarnet.storage.events as store_module
from polarnet.events.stream import Events, slice_time
from polarnet.storage.events import MAX_DURATION_US, EventStore

HEIGHT, WIDTH = 12, 18
DURATIONS_US = {"coffee": 1_000_000, "leaves": 250_500, "still": 40_000}
COUNTS = {"coffee": (300_000, 20, 5000, 1), "leaves": (900, 0, 1200, 800), "still": (0, 0, 0, 0)}
ATTRIBUTES = {"seed": 7, "emulate": {"model": "v2e", "contrast_threshold_on": 0.2}}


@pytest.fixture(scope="module")
def channels(make_random_events):
    return {
        name: [make_random_events(10 * i + k, n, DURATIONS_US[name], HEIGHT, WIDTH) for k, n in enumerate(COUNTS[name])]
        for i, name in enumerate(DURATIONS_US)
    }


@pytest.fixture(scope="module")
def finished(tmp_path_factory, channels) -> Path:
    path = tmp_path_factory.mktemp("store") / "events.zarr"
    store = EventStore.create(path, list(DURATIONS_US), HEIGHT, WIDTH, ATTRIBUTES, 2)
    for name, duration_us in DURATIONS_US.items():
        store.write(name, channels[name], duration_us)
    store.finish()
    return path


def test_events_come_back_as_they_were_and_any_zarr_reader_finds_them_by_their_offsets(finished, channels):
    store = EventStore.open(finished)
    for name in DURATIONS_US:
        assert store.duration_us(name) == DURATIONS_US[name]
        assert store.count(name) == COUNTS[name]
        assert all(equal(a, b) for a, b in zip(store.read(name), channels[name], strict=True))
    header = zarr.open_group(finished, mode="r").attrs
    assert (header["sequences"], header["attributes"]) == (list(DURATIONS_US), ATTRIBUTES)
    assert header["conventions"]["p"] == "polarity: +1 brighter, -1 darker"
    part = zarr.open_group(finished / "part-00000", mode="r")
    record = part.attrs["sequences"]["leaves"]
    first, _ = record["rows"]
    start, stop = record["offsets"][header["polarizer_angles_deg"].index(90) :][:2]
    assert np.array_equal(part["t"][first + start : first + stop], channels["leaves"][2].t.numpy())
    assert record["index"] == [channel.t[:1].tolist() for channel in channels["leaves"]]  # below 16384 events each


def test_analyzers_come_back_those_of_pixels_and_those_of_channels(channels, tmp_path):
    generator = torch.Generator().manual_seed(1)
    uniform, spread = (torch.rand(4, 3, *size, generator=generator) for size in ((), (HEIGHT, WIDTH)))
    expected = dict(zip(DURATIONS_US, (spread, uniform, None), strict=True))
    store = EventStore.create(tmp_path / "some.zarr", list(DURATIONS_US), HEIGHT, WIDTH, {}, 2)
    for name, analyzer in expected.items():
        store.write(name, channels[name], DURATIONS_US[name], analyzer=analyzer)
    store.finish()
    assert EventStore.verify(tmp_path / "some.zarr") == []
    store = EventStore.open(tmp_path / "some.zarr")
    assert store.analyzer("still") is None
    for name in ("coffee", "leaves"):
        assert torch.equal(store.analyzer(name), expected[name])
        assert all(equal(a, b) for a, b in zip(store.read(name), channels[name], strict=True))
    with pytest.raises(ValueError, match=r"analyzers of shape \(4, 3\) or \(4, 3, 12, 18\), got \(4, 3, 2, 2\)"):
        EventStore.create(tmp_path / "x", ["coffee"], HEIGHT, WIDTH, {}).write(
            "coffee", [], 1, None, spread[..., :2, :2]
        )


def test_a_window_reads_only_its_own_chunks(channels, tmp_path, monkeypatch):
    """One channel of 300,000 events in 1 s: 10 ms are 3000 of them, in one or two chunks of 4096 of the 74."""
    monkeypatch.setattr(EventStore, "chunk", 2**12)
    monkeypatch.setattr(store_module, "INDEX_STEP", 2**10)
    store = EventStore.create(tmp_path / "events.zarr", ["coffee"], HEIGHT, WIDTH, {})
    store.write("coffee", channels["coffee"], DURATIONS_US["coffee"])
    store.finish()
    read = []
    get = LocalStore.get

    async def counted(*arguments, **options):
        value = await get(*arguments, **options)
        read.append(len(value))
        return value

    monkeypatch.setattr(LocalStore, "get", counted)
    store = EventStore.open(tmp_path / "events.zarr")
    store.read("coffee")
    whole = sum(read)
    read.clear()
    store.read("coffee", 500_000, 510_000)
    assert sum(read) < 0.1 * whole


def test_a_window_over_several_chunks_is_what_slicing_would_give(make_random_events, tmp_path, monkeypatch):
    monkeypatch.setattr(EventStore, "chunk", 128)
    monkeypatch.setattr(store_module, "INDEX_STEP", 50)
    long = [make_random_events(k, 300 * (k + 1), 99_500, HEIGHT, WIDTH) for k in range(4)]
    short = [make_random_events(k, 40, 9_000, HEIGHT, WIDTH) for k in range(4)]
    store = EventStore.create(tmp_path / "events.zarr", ["long", "short"], HEIGHT, WIDTH, {}, 2)
    store.write("long", long, 99_500)
    store.write("short", short, 9_000)
    store.finish()
    assert EventStore.verify(tmp_path / "events.zarr") == []
    store = EventStore.open(tmp_path / "events.zarr")
    for name, channels in (("long", long), ("short", short)):
        for start_us, stop_us in ((-5, 200_000), (4_000, 5_001), (31_999, 32_001), (99_000, 100_000), (7, 7)):
            window = store.read(name, start_us, stop_us)
            assert all(equal(a, slice_time(b, start_us, stop_us)) for a, b in zip(window, channels, strict=True))
        assert equal(store.read(name, start_us=4_000)[3], slice_time(channels[3], 4_000, 100_000))
        assert equal(store.read(name, stop_us=4_000)[3], slice_time(channels[3], 0, 4_000))


def test_events_that_break_the_format_are_refused_before_anything_is_written(make_events, tmp_path):
    store = EventStore.create(tmp_path / "events.zarr", ["a"], HEIGHT, WIDTH, {})
    good = Events.empty(HEIGHT, WIDTH)
    for words, bad, duration_us in (
        ("polarizer 45: event 1 of 2: expected a time no earlier", [(5, 0, 0, 1), (4, 0, 0, 1)], 1000),
        ("polarizer 45: event 0 of 1: expected x from 0 to 17", [(5, 18, 0, 1)], 1000),
        ("45: expected times from 0 to the duration of 1000 us, got 0 to 1001", [(0, 0, 0, 1), (1001, 0, 0, 1)], 1000),
        (f"expected a duration of 1 to {MAX_DURATION_US} us, got 0", [], 0),
    ):
        with pytest.raises(ValueError, match=words):
            store.write("a", [good, make_events(bad, HEIGHT, WIDTH), good, good], duration_us)
    for words, name, channels in (
        ("polarizer 45: expected a sensor of 12x18 px, got 12x19", "a", [good, Events.empty(HEIGHT, 19), good, good]),
        ("each of 4 polarizers, got 1", "a", [good]),
        ("expected a sequence of a; got 'b'", "b", [good] * 4),
    ):
        with pytest.raises(ValueError, match=words):
            store.write(name, channels, 1000)
    assert store.missing() == ["a"]


def test_sensors_too_large_and_other_groups_are_refused(tmp_path):
    with pytest.raises(ValueError, match="width: expected <= 32767, got 40000"):
        EventStore.create(tmp_path / "events.zarr", ["a"], 1, 40_000, {})
    zarr.open_group(tmp_path / "other.zarr", mode="w")
    assert "expected a store of format 'polarnet.events', got None" in EventStore.verify(tmp_path / "other.zarr")[0]
    assert "there is no Zarr v3 group" in EventStore.verify(tmp_path / "nothing.zarr")[0]


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [("x", 500, "expected x from 0 to 59"), ("p", 3, "expected polarity"), ("t", 0, "expected a time no earlier")],
)
def test_events_that_no_writer_accepts_are_refused_when_they_are_read(tmp_path, monkeypatch, column, value, message):
    monkeypatch.setattr(EventStore, "_check", lambda *_: None)
    columns = {"t": [5, 6], "x": [1, 2], "y": [1, 2], "p": [1, 1]} | {column: [1, value]}
    dtypes = {"t": torch.int64, "x": torch.int16, "y": torch.int16, "p": torch.int8}
    events = Events(*(torch.tensor(columns[name], dtype=dtype) for name, dtype in dtypes.items()), 40, 60)
    store = EventStore.create(tmp_path / "events.zarr", ["a"], 40, 60, {})
    store.write("a", [events] * 4, 1000)
    store.finish()
    for span in ((), (0, 500)):
        with pytest.raises(ValueError, match=rf"events\.zarr: a: event 1 of 2: {message}"):
            EventStore.open(tmp_path / "events.zarr").read("a", *span)


@pytest.mark.parametrize(
    "record",
    [{"duration_us": 10**15}, {"offsets": [0, 2, 1, 3, 4]}, {"offsets": [0, 4]}, {"rows": [-4, 0]}, {"index": []}],
)
def test_a_record_that_no_writer_makes_is_refused(tmp_path, record):
    store = EventStore.create(tmp_path / "events.zarr", ["a"], 40, 60, {})
    one = Events(*torch.ones(1, 1).long(), *torch.ones(2, 1).short(), torch.ones(1).to(torch.int8), 40, 60)
    store.write("a", [one] * 4, 1000)
    known = store.record("a")
    with pytest.raises(ValueError, match=r"a: expected (offsets|a span)"):
        store.check_record("a", {**known, **record})
