from collections import Counter

import numpy as np
import pytest

from polarnet.recordings.repair import FEW, LATE_US, MAX_RUN, MAX_STALE, Clock, repaired
from polarnet.recordings.source import Block, Counts, RecordingError


def read(blocks, height=10, width=10):
    """Rows (t, x, y, p) and counts after repair of blocks of rows."""
    counts = Counts()
    tables = [np.array(rows, np.int64).reshape(-1, 4) for rows in blocks]
    ready = repaired("a.bin", lambda counts: (Block(*table.T) for table in tables), (height, width), counts)
    mended = [np.stack([column.astype(np.int64) for column in block]) for block in ready]
    rows = np.concatenate(mended, axis=1).T.tolist() if mended else []
    return rows, {kind: count for kind, count in counts.items() if count}


def at(times, p=1):
    return [(t, i % 10, i // 10 % 10, p) for i, t in enumerate(times)]


def times_of(rows):
    return [t for t, *_ in rows]


@pytest.mark.parametrize("darker", [0, -1])
def test_polarity_0_and_minus_1_both_mean_darker(darker):
    rows, counts = read([[(1, 1, 1, 1), (2, 1, 1, darker), (3, 1, 1, 1)]])
    assert [p for *_, p in rows] == [1, -1, 1]
    assert counts == {}


def test_a_few_events_of_another_polarity_or_off_the_sensor_are_left_out_and_many_refused():
    rows, counts = read([[(t, 1, 1, 1 - 2 * (t % 2)) for t in range(50)] + [(50, 1, 1, 0), (51, 1, 1, 7)]])
    assert len(rows) == 50
    assert counts == {"bad_polarity": 2}
    inside = at(range(100))
    rows, counts = read([[*inside, (100, 10, 0, 1), (100, 0, -1, 1), (100, 0, 10, 1)]])
    assert (len(rows), counts) == (100, {"out_of_range": 3})
    with pytest.raises(RecordingError, match="Is the format right, and the size of the sensor"):
        read([[*inside, *[(100, 10, 0, 1)] * 9]])
    rows, counts = read([[*at(range(20)), (20, 65536 + 3, 2, 1)]])
    assert (len(rows), counts) == (20, {"out_of_range": 1})


def test_late_events_are_put_in_order_across_blocks_and_those_of_equal_time_keep_theirs():
    rows, counts = read([at([0, 100, 5000]), at([4000, 5001]), at([1, 6000])])
    assert times_of(rows) == [0, 1, 100, 4000, 5000, 5001, 6000]
    assert counts == {"unsorted": 2}
    rows, _ = read([[(5, 1, 0, 1), (5, 2, 0, 1), (3, 3, 0, 1), (5, 4, 0, 1), (3, 5, 0, 1)]])
    assert [x for _, x, *_ in rows] == [3, 5, 1, 2, 4]


def test_one_wild_time_is_left_out_wherever_it_stands():
    sound = list(range(0, 10**6, 10**4))
    for place in (0, 1, 50, 98, 100):
        for wild in (10**12, -(10**12), 2**62):
            rows, counts = read([at([*sound[:place], wild, *sound[place:]])])
            assert times_of(rows) == sound
            assert counts == {"stale" if place == 0 and wild != 2**62 else "time_glitches": 1}


STEADY = list(range(10**6, 4 * 10**6, 1000))
HOUR_US = 3_600_000_000
REFUSED = "time goes back by"


@pytest.mark.parametrize(
    ("times", "file", "live"),
    [
        (STEADY, {}, {}),
        ([*STEADY[:1000], *range(10**6, 10**6 + 10_000, 1000), *STEADY[1000:]], {"time_glitches": 10}, None),
        ([*STEADY[:1000], *range(10**8, 10**8 + 20_000, 1000), *STEADY[1000:]], {"time_glitches": 20}, None),
        ([*STEADY, *range(10**6, 10**6 + 3000, 1000)], {"time_glitches": 3}, None),
        ([*STEADY, *range(2 * HOUR_US, 2 * HOUR_US + 3000, 1000)], {"time_glitches": 3}, None),
        ([*range(5 * 10**9, 5 * 10**9 + 20), *STEADY], {"stale": 20}, None),
        ([*range(8), *(t + 2 * HOUR_US for t in STEADY)], {"stale": 8}, None),
        ([*STEADY[:1000], 20 * 10**6, *STEADY[1000:]], {"time_glitches": 1}, None),
        ([*STEADY, *(t - 10**6 for t in STEADY)], REFUSED, {"clock_resets": 1}),
        ([*STEADY, *STEADY], REFUSED, {"clock_resets": 1}),
        ([*STEADY, *STEADY[:9]], REFUSED, {"clock_resets": 1}),
        ([*STEADY, *range(4 * 10**6 - 50_000, 6 * 10**6, 1000)], REFUSED, {"clock_resets": 1}),
        ([*STEADY, *(t + 2 * HOUR_US for t in STEADY)], {"pauses": 1}, {"clock_resets": 1}),
        ([*STEADY, *(t + 20 * 10**6 for t in STEADY)], {"pauses": 1}, None),
    ],
    ids=[
        "sound", "late", "early", "late at the end", "early at the end", "stale", "stale before", "one wrong time",
        "reset", "joined", "reset near the end", "small reset", "jump of two hours", "pause",
    ],
)  # fmt: skip
def test_the_clock_rule_is_the_same_for_files_and_live_input(times, file, live):
    """Live input differs in resets and jumps alone, after which events go on."""
    rows = at(times)
    if file is REFUSED:
        with pytest.raises(RecordingError, match=r"stays there .*`polarnet convert a.bin OUT --stop \d+us` writes"):
            read([rows])
    else:
        mended, counts = read([rows])
        assert counts == file
        assert len(mended) == len(rows) - sum(counts.get(kind, 0) for kind in ("stale", "time_glitches"))
    for size in (7, 100, len(rows)):
        counts, ready = Counter(), []
        clock = Clock("camera", counts, live=True)
        blocks = [np.array(rows[i : i + size]).T for i in range(0, len(rows), size)]
        for k, (t, x, y, p) in enumerate(blocks):
            for block in clock.ordered(Block(np.ascontiguousarray(t), x, y, p), final=k == len(blocks) - 1):
                ready.extend(block.t.tolist())
        expected = file if live is None else live
        assert {kind: count for kind, count in counts.items() if count} == expected
        assert ready == sorted(ready)
        assert len(ready) == len(rows) - sum(expected.get(kind, 0) for kind in ("stale", "time_glitches"))
        if live:
            assert max(np.diff(ready)) == LATE_US


def test_a_camera_that_was_reset_goes_on_even_if_its_events_come_one_by_one(caplog):
    """Each event waits until its patience has ended; up to 8 are lost until the new clock is believed."""
    counts: Counter[str] = Counter()
    clock = Clock("camera", counts, live=True)
    times = [*range(10**6, 2 * 10**6, 50_000), *range(0, 10**6, 50_000), *range(0, 10**6, 50_000)]
    ready = []
    for row in at(times):
        block = Block(*np.array([row]).T)
        for part in (*clock.ordered(block), *clock.ordered(block.rows(slice(0)), final=True)):
            ready.extend(part.t.tolist())
    assert counts["clock_resets"] == 2
    assert counts["time_glitches"] <= 2 * FEW
    assert len(ready) == len(times) - counts["time_glitches"]
    assert sum("camera's clock goes from" in message for message in caplog.messages) == 1


def test_events_before_a_reset_come_first_and_times_that_fall_all_the_time_are_refused():
    rows = at([*STEADY, *STEADY])
    blocks = repaired("a.bin", lambda counts: iter([Block(*np.array(rows).T)]), (10, 10), Counts())
    assert next(blocks).t.tolist() == STEADY
    with pytest.raises(RecordingError, match=r"a\.bin: after event 3000, time goes back by 2999000 us"):
        next(blocks)
    with pytest.raises(RecordingError, match="and stays there"):
        read([at(range(10**8, 0, -20_000))])
    assert MAX_STALE < MAX_RUN


def test_the_largest_step_back_that_is_repaired_is_ten_milliseconds():
    later = [30_000 + k for k in range(2 * FEW)]
    rows, counts = read([at([20_000, 20_000 - LATE_US, *later])])
    assert (times_of(rows)[0], counts) == (10_000, {"unsorted": 1})
    assert read([at([20_000, 20_000 - LATE_US - 1, *later])])[1] == {"time_glitches": 1}


def test_blocks_of_any_length_give_the_same_events():
    generator = np.random.default_rng(3)
    times = np.cumsum(generator.integers(0, 50, 2000)) + generator.integers(-5000, 5000, 2000)
    rows = at((times + 5000).tolist())
    expected = read([rows])
    for size in (1, 3, FEW, 100, 1999):
        assert read([rows[i : i + size] for i in range(0, len(rows), size)]) == expected
    assert times_of(expected[0]) == sorted(times_of(rows))


def test_fractional_pixels_are_refused():
    columns = Block(np.arange(3), np.array([0.0, 1.5, 2.0]), np.zeros(3), np.ones(3))
    with pytest.raises(RecordingError, match="x and y to be whole numbers"):
        list(repaired("a.bin", lambda counts: iter([columns]), (10, 10), Counts()))
