"""Cut the events of a sequence into windows of time and encode them."""

import itertools
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64, Integer
from torch import Tensor

from polarnet.events.representations import Encode
from polarnet.events.stream import Events, slice_count
from polarnet.runtime.arrays import Array, whole_numbers

BIN_EDGES = (0.0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 13.0, 20.0, math.inf)
"""Bin edges in events per pixel since the start; finer below 2, where the paper sees the change."""


def events_per_pixel(events: Sequence[Events], t_us: Int64[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Mean number of events per pixel before each time (t < time), averaged over the channels."""
    counts = torch.stack([torch.searchsorted(e.t, t_us) for e in events]).double().mean(dim=0)
    return (counts / (events[0].height * events[0].width)).float()


def windows_of(t_us: Int64[Tensor, " n"]) -> list[tuple[int, int]]:
    """(start, stop) of the windows between consecutive frame times: one fewer than there are frames."""
    return list(itertools.pairwise(t_us.tolist()))


def cut_windows(events: Events, t_us: Int64[Tensor, " n"]) -> list[Events]:
    """The events of each window of `windows_of`, half-open: start <= t < stop."""
    return [slice_count(events, start, stop) for start, stop in windows_of(torch.searchsorted(events.t, t_us))]


def encode_windows(channels: Sequence[Events], t_us: Integer[Array, " n"], encode: Encode) -> Float[Tensor, "t c h w"]:
    """Encode every window between consecutive times `t_us`; the second axis holds the channels one after the other.

    ValueError for fewer than two frame times, which leave no window, and for times that do not increase.
    """
    t_us = whole_numbers("t_us", t_us)
    if t_us.ndim != 1 or len(t_us) < 2 or (t_us.diff() <= 0).any():
        raise ValueError(
            f"expected at least two frame times, each later than the last, to have a window, got {t_us.tolist()}"
        )
    lengths = [stop - start for start, stop in windows_of(t_us)]
    per_channel = [
        torch.stack([encode(window, length) for window, length in zip(cut_windows(events, t_us), lengths, strict=True)])
        for events in channels
    ]
    height, width = per_channel[0].shape[-2:]
    return torch.cat([images.view(len(lengths), -1, height, width) for images in per_channel], dim=1)
