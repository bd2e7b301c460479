"""The sensor `clean` is free of noise: it has no event without a cause, and a seed changes nothing but its mismatch."""

import dataclasses

import pytest
import torch

from polarnet.events.stream import Events
from polarnet.simulation.emulator import emulate
from polarnet.simulation.presets import SENSORS

CLEAN = SENSORS["clean"]
ALIKE = dataclasses.replace(CLEAN, contrast_threshold_sigma_on=0.0, contrast_threshold_sigma_off=0.0)
MODELS = ["exact", "v2e"]
SEEDS = (1, 2, 3_000_000_000)


def still_light() -> torch.Tensor:
    """All levels from 0 to 255 DN side by side, for two frames."""
    return torch.arange(256.0).expand(2, 1, 16, 256).contiguous()


def moving_light() -> torch.Tensor:
    """A smooth pattern that drifts by a pixel a frame."""
    pattern = 120 * (1 + torch.sin(torch.arange(120) / 7)) + 5
    return torch.stack([pattern[k : k + 60].expand(1, 16, 60) for k in range(60)])


def emulated(frames: torch.Tensor, step_us: int, model: str, seed: int, sensor=CLEAN) -> Events:
    times_us = step_us * torch.arange(len(frames))
    (events,), _ = emulate(frames, times_us, dataclasses.replace(sensor, model=model), key=seed)
    return events


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("seed", SEEDS)
def test_without_a_change_of_light_nothing_fires_in_an_hour(model, seed):
    assert len(emulated(still_light(), 3_600_000_000, model, seed)) == 0


@pytest.mark.parametrize("model", MODELS)
def test_after_the_light_has_stopped_changing_nothing_fires(model):
    """No leak moves the remembered level, and no photoreceptor lags behind."""
    frames = moving_light()
    held = torch.cat([frames, frames[-1:].expand(10, -1, -1, -1)])
    events = emulated(held, 10_000, model, 1)
    assert len(events) > 10_000
    assert int(events.t.max()) <= 10_000 * (len(frames) - 1)


@pytest.mark.parametrize("model", MODELS)
def test_pixels_without_mismatch_give_the_same_events_for_every_seed(model):
    first, *others = (emulated(moving_light(), 10_000, model, seed, ALIKE) for seed in SEEDS)
    assert len(first) > 10_000
    for other in others:
        assert all(torch.equal(getattr(first, column), getattr(other, column)) for column in "txyp")
