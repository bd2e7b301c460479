"""DVS-Voltmeter's events follow the first-passage law of a Brownian motion with drift."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from event_fixtures import arrays_of
from scipy import stats
from simulation_fixtures import QUIET

from polarnet.simulation.emulator import emulate
from polarnet.simulation.pixels.voltmeter import DVS346

CONFIG = dataclasses.replace(QUIET, model="dvs_voltmeter")
SIDE = 50


def drift_and_noise(before: float, after: float, dt_us: float) -> tuple[float, float]:
    """Drift and diffusion of the voltage, in thresholds per us and per sqrt(us) (the paper's Eq. 10)."""
    k1, k2, k3, k4, k5, k6 = DVS346
    mean = (before + after) / 2
    drift = k1 * (after - before) / dt_us / (mean + k2) + k4 + k5 * mean
    return drift, k3 * math.sqrt(mean) / (mean + k2) + k6


def first_events(before: float, after: float, dt_us: int) -> tuple[np.ndarray, np.ndarray]:
    """Microseconds and polarity of the first event of each of 2500 pixels in one long step."""
    frames = torch.tensor([before, after]).view(2, 1, 1, 1).expand(-1, -1, SIDE, SIDE)
    (events,), _ = emulate(frames, torch.tensor([0, dt_us]), CONFIG, key=11)
    columns = arrays_of(events)
    pixel = columns.y.astype(int) * SIDE + columns.x
    firsts = np.unique(pixel[np.argsort(columns.t, kind="stable")], return_index=True)
    assert len(firsts[0]) == SIDE**2
    order = np.argsort(columns.t, kind="stable")[firsts[1]]
    return columns.t[order], columns.p[order]


@pytest.mark.parametrize(("before", "after", "polarity"), [(60.0, 90.0, 1), (90.0, 20.0, -1)])
def test_the_time_to_the_first_event_is_inverse_gaussian(before, after, polarity):
    dt_us = 2_000_000
    drift, noise = drift_and_noise(before, after, dt_us)
    times, polarities = first_events(before, after, dt_us)
    assert (polarities == polarity).all()
    law = stats.invgauss(mu=noise**2 / abs(drift), scale=1 / noise**2)  # mean 1 / drift, shape 1 / noise^2
    assert law.mean() == pytest.approx(1 / abs(drift))
    assert stats.kstest(times, law.cdf).pvalue > 0.01
