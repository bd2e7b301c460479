"""Hot pixels: their share, their rate, and the silence of those that never fire."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from event_fixtures import arrays_of
from scipy import stats
from simulation_fixtures import QUIET, moving_bars

from polarnet.simulation.emulator import MODELS, EmulatorConfig, emulate
from polarnet.simulation.presets import SENSORS

SIDE = 100  # pixels
CHANNEL = SIDE * SIDE


def constant(config: EmulatorConfig, dn: float, seconds: float):
    """Events of 100 x 100 pixels under constant light."""
    t_us = torch.linspace(0, seconds * 1e6, 11, dtype=torch.float64)
    frames = torch.full((1, 1, SIDE, SIDE), dn).expand(len(t_us), -1, -1, -1)
    (events,), _ = emulate(frames, t_us, config, key=3)
    return arrays_of(events)


def places_of(events) -> np.ndarray:
    return np.asarray(events.y).astype(int) * 1000 + np.asarray(events.x)


def test_hot_pixels_have_the_configured_share_and_are_poisson_processes_of_either_polarity():
    columns = constant(dataclasses.replace(QUIET, hot_pixel_share=0.02, hot_pixel_rate_hz=20.0), 100.0, 10.0)
    pixel = columns.y.astype(int) * SIDE + columns.x
    hot = len(np.unique(pixel))  # a hot pixel without an event in 10 s has probability exp(-200)
    assert hot == pytest.approx(0.02 * CHANNEL, abs=3 * math.sqrt(0.02 * CHANNEL))
    assert len(columns.t) == pytest.approx(200 * hot, abs=3 * math.sqrt(200 * hot))
    assert columns.p.sum() == pytest.approx(0, abs=3 * math.sqrt(200 * hot))
    order = np.lexsort((columns.t, pixel))
    following = pixel[order][1:] == pixel[order][:-1]
    gaps_s = np.diff(columns.t[order])[following] * 1e-6
    assert gaps_s.mean() == pytest.approx(1 / 20.0, rel=0.03)
    assert gaps_s.std() == pytest.approx(gaps_s.mean(), rel=0.03)  # an exponential distribution, but for its cut end
    counts = np.bincount(np.unique(pixel, return_inverse=True)[1])
    assert stats.kstest((columns.t % (1 << 16)) / (1 << 16), "uniform").pvalue > 0.001
    assert counts.var() == pytest.approx(200, rel=0.35)  # equal to the mean


@pytest.mark.parametrize("model", list(MODELS))
def test_hot_pixels_of_rate_0_are_dead_and_the_others_fire_as_before(model):
    config = dataclasses.replace(SENSORS["default"], model=model, shot_noise_rate_hz=5.0)
    frames, t_us = moving_bars(2), 3333 * torch.arange(12)
    dead = dataclasses.replace(config, hot_pixel_share=0.2, hot_pixel_rate_hz=0.0)
    healthy, _ = emulate(frames, t_us, config, key=7)
    partly, _ = emulate(frames, t_us, dead, key=7)
    silent = []
    for before, after in zip(healthy, partly, strict=True):
        lost = np.setdiff1d(places_of(before), places_of(after))
        firing = len(np.unique(places_of(before)))
        assert len(lost) == pytest.approx(0.2 * firing, abs=3 * math.sqrt(0.16 * firing))
        alive = torch.from_numpy(~np.isin(places_of(before), lost))
        for name in "txyp":
            assert torch.equal(getattr(after, name), getattr(before, name)[alive])
        silent.append(lost)
    assert not np.array_equal(*silent)  # each channel has its own
