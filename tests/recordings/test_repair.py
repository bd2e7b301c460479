from collections import Counter

import numpy as np
import pytest

from polarnet.recordings.repair import LATE_US, LOOKAHEAD, repaired
from polarnet.recordings.source import Block, RecordingError, Source


def read(blocks, height=10, width=10):
    """Rows (t, x, y, p) and counts after repair of blocks of rows."""
    counts = Counter()
    tables = [np.array(rows, np.int64).reshape(-1, 4) for rows in blocks]
    source = Source(height, width, lambda counts: (Block(*table.T) for table in tables))
    mended = [np.stack([column.astype(np.int64) for column in block]) for block in repaired("a.bin", source, counts)]
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


def test_a_few_polarities_of_the_other_kind_are_left_out():
    rows, counts = read([[(t, 1, 1, 1 - 2 * (t % 2)) for t in range(50)] + [(50, 1, 1, 0), (51, 1, 1, 7)]])
    assert len(rows) == 50
    assert counts == {"bad_polarity": 2}


def test_a_few_events_off_the_sensor_are_left_out_and_many_refused():
    inside = at(range(100))
    rows, counts = read([[*inside, (100, 10, 0, 1), (100, 0, -1, 1), (100, 0, 10, 1)]])
    assert (len(rows), counts) == (100, {"out_of_range": 3})
    with pytest.raises(RecordingError, match="Is the format right, and the size of the sensor"):
        read([[*inside, *[(100, 10, 0, 1)] * 9]])


def test_coordinates_larger_than_int16_do_not_wrap_onto_the_sensor():
    rows, counts = read([[*at(range(20)), (20, 65536 + 3, 2, 1)]])
    assert (len(rows), counts) == (20, {"out_of_range": 1})


def test_late_events_are_put_in_order_across_blocks():
    rows, counts = read([at([0, 100, 5000]), at([4000, 5001]), at([1, 6000])])
    assert times_of(rows) == [0, 1, 100, 4000, 5000, 5001, 6000]
    assert counts == {"unsorted": 2}


def test_events_of_equal_time_keep_their_order():
    rows, _ = read([[(5, 1, 0, 1), (5, 2, 0, 1), (3, 3, 0, 1), (5, 4, 0, 1), (3, 5, 0, 1)]])
    assert [x for _, x, *_ in rows] == [3, 5, 1, 2, 4]


def test_one_wild_time_is_left_out_wherever_it_stands():
    sound = list(range(0, 10**6, 10**4))
    for place in (0, 1, 50, 98):
        for wild in (10**12, -(10**12), 2**62):
            rows, counts = read([at([*sound[:place], wild, *sound[place:]])])
            assert times_of(rows) == sound
            assert counts == {"time_glitches": 1}


def test_a_clock_that_was_set_anew_is_refused_with_the_place():
    times = [*range(10**6, 10**6 + 1000), *range(1000)]
    message = r"a\.bin: after event 1000, time goes back by 1000999 us, from 1000999 to 0 us, and stays there"
    with pytest.raises(RecordingError, match=message):
        read([at(times)])


def test_the_largest_step_back_that_is_repaired_is_ten_milliseconds():
    later = [30_000 + k for k in range(2 * LOOKAHEAD)]
    rows, counts = read([at([20_000, 20_000 - LATE_US, *later])])
    assert (times_of(rows)[0], counts) == (10_000, {"unsorted": 1})
    assert read([at([20_000, 20_000 - LATE_US - 1, *later])])[1] == {"time_glitches": 1}


def test_pauses_are_kept_and_counted():
    rows, counts = read([at([0, 1, 3_000_000, 3_000_001, 9_000_000])])
    assert (times_of(rows), counts) == ([0, 1, 3_000_000, 3_000_001, 9_000_000], {"pauses": 2})


def test_blocks_of_any_length_give_the_same_events():
    generator = np.random.default_rng(3)
    times = np.cumsum(generator.integers(0, 50, 2000)) + generator.integers(-5000, 5000, 2000)
    rows = at((times + 5000).tolist())
    expected = read([rows])
    for size in (1, 3, LOOKAHEAD, 100, 1999):
        assert read([rows[i : i + size] for i in range(0, len(rows), size)]) == expected
    assert times_of(expected[0]) == sorted(times_of(rows))


def test_fractional_pixels_are_refused():
    columns = Block(np.arange(3), np.array([0.0, 1.5, 2.0]), np.zeros(3), np.ones(3))
    source = Source(10, 10, lambda counts: iter([columns]))
    with pytest.raises(RecordingError, match="x and y to be whole numbers"):
        list(repaired("a.bin", source, Counter()))
