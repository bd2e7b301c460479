"""Operations on a stream of events, and a mosaic of polarizers: one sensor and its four channels."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from polarnet.events.stream import (
    Events,
    concatenate,
    crop,
    downscale,
    join_mosaic,
    merge,
    slice_time,
    split_mosaic,
    validate,
)
from polarnet.stokes import POLARIZER_ANGLES_DEG, parse_mosaic


def rows(events: Events) -> list[tuple[int, ...]]:
    return list(zip(*(c.tolist() for c in (events.t, events.x, events.y, events.p)), strict=True))


def test_a_time_slice_holds_its_start_but_not_its_stop_and_a_crop_counts_from_its_own_corner(make_events):
    events = make_events([(0, 0, 0, 1), (10, 1, 0, 1), (20, 2, 0, -1), (20, 3, 0, 1), (30, 4, 0, 1)], 1, 5)
    assert slice_time(events, 10, 20).x.tolist() == [1]
    assert slice_time(events, 20, 31).x.tolist() == [2, 3, 4]
    assert len(slice_time(events, 31, 40)) == 0
    events = make_events([(0, 4, 3, 1), (1, 5, 3, -1), (2, 7, 5, 1), (3, 8, 3, 1)], 8, 10)
    assert rows(crop(events, top=3, left=5, height=3, width=3)) == [(1, 0, 0, -1), (2, 2, 2, 1)]


def test_sizes_types_and_lengths_that_do_not_fit_are_refused(make_events):
    with pytest.raises(ValueError, match="rows 3 to 9"):
        crop(make_events([], 8, 10), top=3, left=0, height=6, width=3)
    with pytest.raises(ValueError, match="8x10"):
        downscale(make_events([], 8, 10), 16, 5)
    with pytest.raises(ValueError, match="one sensor"):
        merge([Events.empty(2, 2), Events.empty(2, 3)])
    events = make_events([(0, 0, 0, 1)], 1, 1)
    with pytest.raises(Exception, match="p"):
        Events(events.t, events.x, events.y, events.p.float(), 1, 1)
    with pytest.raises(Exception, match="x"):
        Events(events.t, events.x.repeat(2), events.y, events.p, 1, 1)
    with pytest.raises(ValueError, match="sides of 1 to 32767 px, got 0x1"):
        Events.empty(0, 1)


def test_downscaling_divides_coordinates_at_any_ratio_and_the_polarity_sum_by_the_number_of_pixels(make_random_events):
    """The paper's 240x400 pixels to 120x180; a coarse pixel holds back less than one threshold."""
    events = make_random_events(0, 200_000, 10_000, 240, 400)
    coarse = validate(downscale(replace(events, p=events.p.abs()), 120, 180))
    assert (int(coarse.x.max()), int(coarse.y.max())) == (179, 119)
    expected = 200_000 / (240 * 400 / (120 * 180))
    assert expected - 120 * 180 < len(coarse) <= expected


def test_downscaling_at_one_pixels_rate_needs_four_fine_events_for_a_coarse_one(make_events):
    """Four pixels that each brighten by one threshold brighten their mean by one threshold."""
    brighter = [(t, t % 2, t // 2 % 2, 1) for t in range(8)]
    darker = [(8 + t, t % 2, t // 2 % 2, -1) for t in range(4)]
    coarse = downscale(make_events(brighter + darker, 2, 2), 1, 1)
    assert rows(coarse) == [(3, 0, 0, 1), (7, 0, 0, 1), (11, 0, 0, -1)]
    flicker = make_events([(t, t % 2, 0, 1 - 2 * (t % 2)) for t in range(20)], 1, 2)
    assert len(downscale(flicker, 1, 1)) == 0


def test_pieces_that_overlap_in_time_are_not_joined_but_merged(make_events):
    first = make_events([(0, 0, 0, 1), (10, 0, 0, 1)], 1, 2)
    second = make_events([(5, 1, 0, -1), (10, 1, 0, -1)], 1, 2)
    with pytest.raises(ValueError, match=r"piece 1 starts at 5 us, before .* 10 us; merge\(\)"):
        concatenate([first, second])
    assert rows(merge([first, second])) == [(0, 0, 0, 1), (5, 1, 0, -1), (10, 0, 0, 1), (10, 1, 0, -1)]


@pytest.mark.parametrize("place", [1, 500, 999])
@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        ("t", -1, "a time no earlier than that of the event before"), ("x", 3, "x from 0 to 2"),
        ("x", -1, "x from 0 to 2"), ("y", 2, "y from 0 to 1"), ("y", -1, "y from 0 to 1"),
        ("p", 0, r"polarity \+1 or -1"), ("p", 2, r"polarity \+1 or -1"),
    ],
)  # fmt: skip
def test_validate_names_the_one_wrong_event_wherever_it_is(make_events, place, column, value, expected):
    events = make_events([(10 + i // 3, i % 3, i % 2, 1 - i % 2 * 2) for i in range(1000)], 2, 3)
    assert validate(events) is events
    getattr(events, column)[place] = value
    with pytest.raises(ValueError, match=f"event {place} of 1000: expected {expected}, got .*{column}={value}"):
        validate(events)


@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.int64])
def test_columns_of_any_integer_type_make_events(dtype):
    t, x, y = (np.array(values, dtype) for values in ([5, 7], [0, 3], [1, 2]))
    events = Events.from_columns(t, torch.from_numpy(x.astype(np.int64)), y, np.array([1, -1]), height=3, width=4)
    assert rows(events) == [(5, 0, 1, 1), (7, 3, 2, -1)]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"p": np.array([0, 1])}, r"event 0 of 2: expected polarity \+1 or -1, got t=5, x=0, y=1, p=0"),
        ({"x": np.array([0, 4])}, "event 1 of 2: expected x from 0 to 3"),
        ({"x": np.array([0, 65536])}, "expected x that fit torch.int16, got 0 to 65536"),
        ({"t": np.array([7, 5])}, "event 1 of 2: expected a time no earlier"),
        ({"t": np.array([0.5, 0.7])}, "t: expected whole numbers, got torch.float64"),
        ({"y": np.array([1])}, r"expected y as torch.int16 of shape \(2,\)"),
    ],
)
def test_columns_that_are_no_events_are_refused(unchecked_annotations, changes, message):
    columns = {"t": np.array([5, 7]), "x": np.array([0, 3]), "y": np.array([1, 2]), "p": np.array([1, -1])}
    with pytest.raises(ValueError, match=message):
        Events.from_columns(**(columns | changes), height=3, width=4)


@pytest.mark.parametrize("order", ["90 45 / 135 0", "0 45 / 90 135"])
def test_a_mosaic_gives_each_channel_the_pixels_of_its_angle(order):
    mosaic = parse_mosaic(order)
    y, x = (axis.ravel() for axis in np.indices((5, 7)))  # every pixel once; the last row and column are of no cell
    t = torch.arange(35)
    events = Events(t, *(torch.from_numpy(c.astype(np.int16)) for c in (x, y)), torch.ones(35, dtype=torch.int8), 5, 7)
    channels = split_mosaic(events, mosaic)
    assert sum(map(len, channels)) == 24
    for angle, channel in zip(POLARIZER_ANGLES_DEG, channels, strict=True):
        assert (channel.height, channel.width) == (2, 3)
        for time, row, column in zip(channel.t.tolist(), channel.y.tolist(), channel.x.tolist(), strict=True):
            assert (row, column) == (int(y[time]) // 2, int(x[time]) // 2)
            assert mosaic[int(y[time]) % 2][int(x[time]) % 2] == angle


def test_joined_channels_lie_at_the_places_of_their_angles_in_time_order_and_split_again(make_events):
    mosaic = parse_mosaic("90 45 / 135 0")
    channels = [make_events([(10 - number, 0, 0, 1), (20, 1, 1, -1)], 2, 2) for number in range(4)]
    sensor = join_mosaic(channels, mosaic)
    assert (sensor.height, sensor.width) == (4, 4)
    columns = (sensor.t, sensor.y, sensor.x)
    assert list(zip(*(column.tolist() for column in columns), strict=True)) == [
        (7, 1, 0), (8, 0, 0), (9, 0, 1), (10, 1, 1), (20, 2, 2), (20, 2, 3), (20, 3, 2), (20, 3, 3)
    ]  # fmt: skip
    for again, channel in zip(split_mosaic(sensor, mosaic), channels, strict=True):
        assert all(torch.equal(getattr(again, name), getattr(channel, name)) for name in ("t", "x", "y", "p"))


def test_a_sensor_without_a_whole_cell_is_refused():
    with pytest.raises(ValueError, match="at least 2x2 pixels, got 1x6"):
        split_mosaic(Events.empty(1, 6), parse_mosaic("90 45 / 135 0"))
