"""Hot pixels of a recording: found by how much more they fire than those around them, and left out."""

import cv2
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
    """Pixels that fire `factor` times as often as those around them and those of the whole sensor do, together.

    Those around: the median of 5x5 pixels, which moving edges raise as well. A pixel of less than 20 Hz is never hot.
    """
    counts = event_counts(events).astype(np.float32)
    if not len(events):
        return np.zeros(counts.shape, np.bool_)
    around = cv2.medianBlur(counts, NEIGHBOURHOOD)
    duration_s = float(events.t[-1] - events.t[0]) * 1e-6
    return counts > np.maximum(factor * (around + counts.mean()), SLOWEST_HOT_HZ * duration_s)


def without_pixels(events: Events, bad: Bool[np.ndarray, "h w"]) -> Events:
    """The events of the other pixels."""
    if not bad.any():
        return events
    keep = ~torch.from_numpy(bad)[events.y.long(), events.x.long()]
    return Events(events.t[keep], events.x[keep], events.y[keep], events.p[keep], events.height, events.width)
