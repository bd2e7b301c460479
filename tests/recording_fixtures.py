"""Small recordings."""

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events


def events_of(rows, height, width) -> Events:
    """Events of rows (t_us, x, y, p)."""
    t, x, y, p = np.array(rows, np.int64).reshape(-1, 4).T
    return Events(*_columns(t, x, y, p), height, width)


def random_events(seed: int, count: int, duration_us: int, height: int = 800, width: int = 1280) -> Events:
    generator = np.random.default_rng(seed)
    t = np.sort(generator.integers(0, duration_us, count, endpoint=True))
    x, y = generator.integers(0, width, count), generator.integers(0, height, count)
    return Events(*_columns(t, x, y, 2 * generator.integers(0, 2, count) - 1), height, width)


def _columns(t, x, y, p):
    types = (np.int64, np.int16, np.int16, np.int8)
    return (torch.from_numpy(values.astype(dtype)) for values, dtype in zip((t, x, y, p), types, strict=True))


def equal(a: Events, b: Events) -> bool:
    return (a.height, a.width) == (b.height, b.width) and all(torch.equal(getattr(a, c), getattr(b, c)) for c in "txyp")


@pytest.fixture(scope="session")
def make_events():
    return events_of


@pytest.fixture(scope="session")
def make_random_events():
    return random_events


@pytest.fixture(scope="session")
def same_events():
    return equal
