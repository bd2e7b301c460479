"""Small event streams and stores."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events
from polarnet.simulation.pixels.columns import Columns

MakeEvents = Callable[..., Events]


def events_of(rows: Sequence[tuple[int, int, int, int]], height: int, width: int) -> Events:
    t, x, y, p = (list(column) for column in zip(*rows, strict=True)) if rows else ([], [], [], [])
    return Events(
        torch.tensor(t, dtype=torch.int64),
        torch.tensor(x, dtype=torch.int16),
        torch.tensor(y, dtype=torch.int16),
        torch.tensor(p, dtype=torch.int8),
        height,
        width,
    )


def random_events(seed: int, count: int, duration_us: int, height: int, width: int) -> Events:
    generator = np.random.default_rng(seed)
    return Events(
        torch.from_numpy(np.sort(generator.integers(0, duration_us, count, endpoint=True))),
        torch.from_numpy(generator.integers(0, width, count).astype(np.int16)),
        torch.from_numpy(generator.integers(0, height, count).astype(np.int16)),
        torch.from_numpy((2 * generator.integers(0, 2, count) - 1).astype(np.int8)),
        height,
        width,
    )


@pytest.fixture(scope="session")
def make_events() -> MakeEvents:
    """Events of rows (t_us, x, y, p)."""
    return events_of


@pytest.fixture(scope="session")
def make_random_events() -> MakeEvents:
    return random_events


def arrays_of(events: Events) -> Columns:
    """The columns of events as numpy arrays."""
    return Columns(*(getattr(events, name).numpy() for name in "txyp"))
