"""Tiny stores of random events with smooth truth, so that a whole training takes a second."""

from pathlib import Path

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events
from polarnet.runtime.machine import generator_for
from polarnet.storage import Contents, EventStore, FrameStore

HEIGHT, WIDTH, WINDOWS, WINDOW_US = 16, 24, 6, 10_000
SPLITS = {"a": "train", "b": "train", "c": "train", "d": "val", "e": "test"}


def random_events(generator: np.random.Generator, count: int) -> Events:
    t = np.sort(generator.integers(0, WINDOWS * WINDOW_US, count))
    return Events(
        torch.from_numpy(t),
        torch.from_numpy(generator.integers(0, WIDTH, count, dtype=np.int16)),
        torch.from_numpy(generator.integers(0, HEIGHT, count, dtype=np.int16)),
        torch.from_numpy(generator.choice(np.array([-1, 1], dtype=np.int8), count)),
        HEIGHT,
        WIDTH,
    )


def smooth_truth(generator: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Intensity, DoLP and AoLP of a scene at rest: ramps across the image."""
    down, right = torch.meshgrid(torch.linspace(0, 1, HEIGHT), torch.linspace(0, 1, WIDTH), indexing="ij")
    a, b, c = torch.from_numpy(generator.random((3, 1, 1), dtype=np.float32))
    fields = [a * down, b * right, c * (down + right) / 2]
    intensity, dolp, aolp = (field.expand(WINDOWS + 1, HEIGHT, WIDTH) for field in fields)
    return intensity[:, None].expand(-1, 4, -1, -1), dolp, aolp


@pytest.fixture(scope="session")
def stores(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Paths of an event store and a frame store of five sequences."""
    folder = tmp_path_factory.mktemp("stores")
    events = EventStore.create(folder / "events.zarr", list(SPLITS), HEIGHT, WIDTH, {})
    frames = FrameStore.create(folder / "frames.zarr", Contents(SPLITS), HEIGHT, WIDTH)
    t_us = WINDOW_US * torch.arange(WINDOWS + 1)
    for name in SPLITS:
        generator = generator_for(1, name, "test")
        events.write(name, [random_events(generator, 400) for _ in range(4)], WINDOWS * WINDOW_US)
        frames.write(name, t_us, *smooth_truth(generator))
    events.finish()
    frames.finish()
    return folder / "events.zarr", folder / "frames.zarr"
