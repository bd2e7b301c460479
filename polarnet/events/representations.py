"""Encode events as dense network input."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Float32, Int8, Int16, Int64
from torch import Tensor

from polarnet.events.stream import Events
from polarnet.runtime.compilation import compiled

VOXEL_BINS = 5  # as in E2VID (Rebecq et al. 2019) and FireNet

Encode = Callable[[Events, int], Tensor]


def event_tensor(events: Events, window_us: int) -> Float[Tensor, "h w"]:
    """Polarities summed per pixel, each weighted by its time since the first event (paper Eq. 5).

    Time counts from the first event of this channel in the window, in window lengths.
    """
    elapsed = (events.t - events.t[:1]) / window_us
    image = elapsed.new_zeros(events.height * events.width).index_add_(0, _pixel(events), events.p * elapsed)
    return image.view(events.height, events.width)


def polarity_sums(events: Events) -> Float[Tensor, "h w"]:
    """ON minus OFF events of each pixel."""
    image = torch.zeros(events.height * events.width, device=events.p.device)
    return image.index_add(0, _pixel(events), events.p.float()).view(events.height, -1)


def voxel_grid(events: Events, bins: int) -> Float[Tensor, "bins h w"]:
    """Each polarity split between the two nearest of `bins` instants (E2VID, Rebecq et al. 2019).

    t* = (bins - 1) (t - first) / (last - first): the first event is in bin 0 and the last in bin (bins - 1), whatever
    the window's length. If all events have the same time, they are in bin 0.
    """
    size = events.height * events.width
    grid = torch.zeros(bins * size, device=events.t.device)
    if len(events):
        elapsed = events.t - events.t[0]
        position = (bins - 1) * elapsed / elapsed[-1].clamp(min=1)
        bin_before = position.long().clamp(max=max(bins - 2, 0))  # the last event belongs wholly to the later bin
        share_after = position - bin_before
        place = bin_before * size + _pixel(events)
        grid.index_add_(0, place, events.p * (1 - share_after))
        if bins > 1:
            grid.index_add_(0, place + size, events.p * share_after)
    return grid.view(bins, events.height, events.width)


def normalise_nonzero(grids: Float[Tensor, "*b c h w"]) -> Float[Tensor, "*b c h w"]:
    """Nonzero entries normalised to mean 0 and standard deviation 1, grid by grid, as in E2VID; equal ones to 0."""
    filled = grids != 0
    over = (-3, -2, -1)
    count = filled.sum(over, keepdim=True).clamp(min=1)
    centred = torch.where(filled, grids - grids.sum(over, keepdim=True) / count, 0.0)
    deviation = (centred.square().sum(over, keepdim=True) / count).sqrt()
    return centred / torch.where(deviation > 0, deviation, 1.0)


def event_counts(events: Events, window_us: int) -> Float[Tensor, "2 h w"]:
    """Per pixel, the sum of polarities (change of log intensity in contrast thresholds) and the number of events."""
    images = torch.zeros(2, events.height, events.width)
    _count(*(column.cpu().contiguous().numpy() for column in (events.x, events.y, events.p)), images.numpy())
    return images.to(events.p.device)


def voxel_grid_of_window(events: Events, window_us: int) -> Float[Tensor, "bins h w"]:
    """`voxel_grid` with E2VID's 5 bins, which span the events whatever the window's length."""
    return voxel_grid(events, VOXEL_BINS)


REPRESENTATIONS: dict[str, Encode] = {
    "event_tensor": event_tensor,
    "event_counts": event_counts,
    "voxel_grid": voxel_grid_of_window,
}
"""Encoders by name: (events of one channel, window length in microseconds) -> one image or a stack."""


def channels_of(encode: Encode) -> int:
    """Number of images that a representation makes of one channel's events."""
    shape = encode(Events.empty(1, 1), 1).shape
    return shape[0] if len(shape) == 3 else 1


@compiled
def _count(
    x: Int16[np.ndarray, " n"],
    y: Int16[np.ndarray, " n"],
    p: Int8[np.ndarray, " n"],
    images: Float32[np.ndarray, "2 h w"],
) -> None:
    """Add events to the images of `event_counts`; several times as fast as torch's index_add."""
    for i in range(len(p)):
        images[0, y[i], x[i]] += p[i]
        images[1, y[i], x[i]] += 1


def _pixel(events: Events) -> Int64[Tensor, " n"]:
    return events.y.long() * events.width + events.x
