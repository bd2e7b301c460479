"""Events of a sensor with a 2x2 mosaic of polarizers (DoFP): into its four channels, and back."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from polarnet.events.stream import Events, merge, select
from polarnet.stokes import Mosaic


def places_of(mosaic: Mosaic) -> list[tuple[int, int]]:
    """(row, column) in a 2x2 cell of the pixels at 0, 45, 90 and 135 degrees."""
    return [divmod(int(cell), 2) for cell in np.argsort(np.ravel(mosaic))]


def split_mosaic(events: Events, mosaic: Mosaic) -> list[Events]:
    """The four channels, in the order 0, 45, 90, 135 degrees, of a sensor with polarizers on its pixels.

    Each channel has half of the sensor's rows and columns: its pixel for a 2x2 cell fires when that angle's pixel in
    the cell does. Events of an odd last row or column are left out. ValueError for a sensor without a whole cell.
    """
    height, width = events.height // 2, events.width // 2
    if not (height and width):
        raise ValueError(f"expected a mosaic of at least 2x2 pixels, got {events.height}x{events.width}")
    complete = (events.y < 2 * height) & (events.x < 2 * width)
    channels = []
    for row, column in places_of(mosaic):
        own = select(events, complete & (events.y & 1 == row) & (events.x & 1 == column))
        channels.append(replace(own, x=own.x // 2, y=own.y // 2, height=height, width=width))
    return channels


def join_mosaic(channels: Sequence[Events], mosaic: Mosaic) -> Events:
    """The inverse of `split_mosaic`; events of one time come row by row."""
    placed = [
        replace(e, y=2 * e.y + row, x=2 * e.x + column, height=2 * e.height, width=2 * e.width)
        for e, (row, column) in zip(channels, places_of(mosaic), strict=True)
    ]
    sensor = merge(placed)
    order = np.lexsort([column.numpy() for column in (sensor.p, sensor.x, sensor.y, sensor.t)])
    return select(sensor, torch.from_numpy(order))
