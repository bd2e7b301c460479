"""Small event streams."""

from collections.abc import Sequence

import numpy as np
import torch

from polarnet.events.stream import Events
from polarnet.simulation.pixels.columns import Columns

TYPES = {"t": np.int64, "x": np.int16, "y": np.int16, "p": np.int8}


def events_of(rows: Sequence[tuple[int, int, int, int]], height: int, width: int) -> Events:
    """Events of rows (t_us, x, y, p)."""
    return _events(*np.array(rows, np.int64).reshape(-1, 4).T, height, width)


def random_events(seed: int, count: int, duration_us: int, height: int = 800, width: int = 1280) -> Events:
    generator = np.random.default_rng(seed)
    t = np.sort(generator.integers(0, duration_us, count, endpoint=True))
    x, y = generator.integers(0, width, count), generator.integers(0, height, count)
    return _events(t, x, y, 2 * generator.integers(0, 2, count) - 1, height, width)


def _events(t, x, y, p, height: int, width: int) -> Events:
    """Events that are not checked, because some tests want wrong ones."""
    columns = (values.astype(dtype) for values, dtype in zip((t, x, y, p), TYPES.values(), strict=True))
    return Events(*map(torch.from_numpy, columns), height, width)


def equal(a: Events, b: Events) -> bool:
    return (a.height, a.width) == (b.height, b.width) and all(torch.equal(getattr(a, c), getattr(b, c)) for c in TYPES)


def arrays_of(events: Events) -> Columns:
    """The columns of events as numpy arrays."""
    return Columns(*(getattr(events, name).numpy() for name in TYPES))
