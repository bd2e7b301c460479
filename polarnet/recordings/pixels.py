"""Find and remove the hot pixels of a recording: those that fire far more often than their neighbours."""

import numpy as np
import torch
from jaxtyping import Bool, Int

from polarnet.events.stream import Events, select

NEIGHBOURHOOD = 5  # side of a square, in pixels
HOT_FACTOR = 4.0  # default of the commands
MIN_HOT_HZ = 20.0  # slower pixels are harmless in a scene
MIN_EVENTS = 8  # fewer events are no evidence


def event_counts(events: Events) -> Int[np.ndarray, "h w"]:
    """Number of events of each pixel."""
    pixel = events.y.long() * events.width + events.x.long()
    counts = torch.bincount(pixel, minlength=events.height * events.width)
    return counts.view(events.height, events.width).numpy()


def hot_pixels(
    counts: Int[np.ndarray, "h w"], duration_s: float, factor: float | int, min_hz: float = MIN_HOT_HZ
) -> Bool[np.ndarray, "h w"]:
    """Pixels that fired more than `factor` times as often as the third busiest of the 5x5 pixels around them.

    `counts` are the events of each pixel in `duration_s`. The third busiest is the reference so that thin lines and
    their ends are not hot, but two hot neighbours are. Pixels with less than `min_hz`, or 8 events, never are.
    """
    border = NEIGHBOURHOOD // 2
    around = np.lib.stride_tricks.sliding_window_view(np.pad(counts, border), (NEIGHBOURHOOD, NEIGHBOURHOOD))
    hot = (counts >= MIN_EVENTS) & (counts > min_hz * duration_s)
    third = np.partition(around[hot].reshape(-1, NEIGHBOURHOOD**2), -3, axis=-1)[:, -3]
    hot[hot] = counts[hot] > factor * third
    return hot


def without_pixels(events: Events, bad: Bool[np.ndarray, "h w"]) -> Events:
    """The events of all pixels outside `bad`."""
    if not bad.any():
        return events
    return select(events, ~torch.from_numpy(bad)[events.y.long(), events.x.long()])
