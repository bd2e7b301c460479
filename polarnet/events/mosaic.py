"""Events of a sensor with a 2x2 mosaic of polarizers (DoFP): into its four channels, and back."""

from collections.abc import Sequence

import numpy as np
import torch

from polarnet.events.stream import Events
from polarnet.stokes import Mosaic


def places_of(mosaic: Mosaic) -> list[tuple[int, int]]:
    """(row, column) in a 2x2 cell of the pixels at 0, 45, 90 and 135 degrees."""
    return [divmod(int(cell), 2) for cell in np.argsort(np.ravel(mosaic))]


def split_mosaic(events: Events, mosaic: Mosaic) -> list[Events]:
    """The four channels, in the order 0, 45, 90, 135 degrees, of a sensor with polarizers on its pixels.

    Each channel has half of the sensor's rows and columns. Its pixel for a 2x2 cell fires when that angle's pixel in
    the cell does. Events keep their times, and none is added; only those of an odd last row or column are left out. The
    four pixels of a cell look at places half a cell apart, so an edge crosses them one after the other. ValueError for
    a sensor without a whole cell.
    """
    height, width = events.height // 2, events.width // 2
    if not (height and width):
        raise ValueError(f"expected a mosaic of at least 2x2 pixels, got {events.height}x{events.width}")
    complete = (events.y < 2 * height) & (events.x < 2 * width)
    channels = []
    for row, column in places_of(mosaic):
        own = complete & (events.y & 1 == row) & (events.x & 1 == column)
        x, y = events.x[own] // 2, events.y[own] // 2
        channels.append(Events(events.t[own], x, y, events.p[own], height, width))
    return channels


def join_mosaic(channels: Sequence[Events], mosaic: Mosaic) -> Events:
    """The inverse of `split_mosaic`; events of one time come row by row."""
    t, y, x, p = (
        torch.cat(columns)
        for columns in zip(
            *(
                (e.t, 2 * e.y + row, 2 * e.x + column, e.p)
                for e, (row, column) in zip(channels, places_of(mosaic), strict=True)
            ),
            strict=True,
        )
    )
    order = torch.from_numpy(np.lexsort((p.numpy(), x.numpy(), y.numpy(), t.numpy())))
    return Events(t[order], x[order], y[order], p[order], 2 * channels[0].height, 2 * channels[0].width)
