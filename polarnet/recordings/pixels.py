"""Hot pixels of a recording: found by how much more they fire than those around them, and left out."""

import numpy as np
import torch
from jaxtyping import Bool, Int32

from polarnet.events.stream import Events

NEIGHBOURHOOD = 5  # pixels, square
SLOWEST_HOT_HZ = 20.0  # a pixel that fires less does no harm


def event_counts(events: Events) -> Int32[np.ndarray, "h w"]:
    """How often each pixel fired."""
    pixel = events.y.long() * events.width + events.x.long()
    counts = torch.bincount(pixel, minlength=events.height * events.width)
    return counts.view(events.height, events.width).int().numpy()


def hot_pixels(events: Events, factor: float | int) -> Bool[np.ndarray, "h w"]:
    """Pixels that fire more than `factor` times as often as the third busiest of the 5x5 pixels around them.

    The third: thin lines and their ends are not hot, two hot neighbours are. Pixels of less than 20 Hz never are.
    """
    counts = event_counts(events)
    if not len(events):
        return np.zeros(counts.shape, np.bool_)
    border = NEIGHBOURHOOD // 2
    around = np.lib.stride_tricks.sliding_window_view(np.pad(counts, border), (NEIGHBOURHOOD, NEIGHBOURHOOD))
    third = np.partition(around.reshape(*counts.shape, -1), -3, axis=-1)[..., -3]
    duration_s = float(events.t[-1] - events.t[0]) * 1e-6
    return counts > np.maximum(factor * third, SLOWEST_HOT_HZ * duration_s)


def without_pixels(events: Events, bad: Bool[np.ndarray, "h w"]) -> Events:
    """The events of the other pixels."""
    if not bad.any():
        return events
    keep = ~torch.from_numpy(bad)[events.y.long(), events.x.long()]
    return Events(events.t[keep], events.x[keep], events.y[keep], events.p[keep], events.height, events.width)
