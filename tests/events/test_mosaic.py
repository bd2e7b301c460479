"""Events of a mosaic of polarizers: one sensor and its four channels."""

import numpy as np
import pytest
import torch

from polarnet.events.mosaic import join_mosaic, split_mosaic
from polarnet.events.stream import Events
from polarnet.stokes import POLARIZER_ANGLES_DEG, parse_mosaic


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
