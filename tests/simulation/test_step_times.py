"""Times of frames that a step cannot hold, and steps with very many events."""

import dataclasses

import numpy as np
import pytest
import torch
from simulation_fixtures import QUIET, REST, STILL

from polarnet.events.stream import concatenate, validate
from polarnet.simulation.camera import Camera, grid
from polarnet.simulation.emulator import MODELS, emulate
from polarnet.simulation.motion import Trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.pixels.columns import MAX_STEP_US
from polarnet.simulation.rotating import RotatingConfig, emulate_rotating
from polarnet.simulation.scene import PolarizationScene

STEP = torch.tensor([50.0, 200.0]).view(2, 1, 1, 1).expand(2, 1, 3, 3)
MODEL_NAMES = pytest.mark.parametrize("model", list(MODELS))


def of(model: str, **changes):
    return dataclasses.replace(QUIET, model=model, **changes)


@MODEL_NAMES
@pytest.mark.parametrize("start_us", [0.0, -5e6, 2.0**31 - 1e6, 2.0**51])
def test_a_step_of_71_minutes_has_its_events_within_it_and_a_longer_one_is_refused(model, start_us):
    config = of(model, refractory_period_us=500.0)
    t_us = torch.tensor([start_us, start_us + MAX_STEP_US], dtype=torch.float64)
    (events,), state = emulate(STEP, t_us, config, key=1)
    assert len(validate(events)) >= 9 * 5
    assert events.t.min() >= start_us
    assert events.t.max() <= start_us + MAX_STEP_US
    with pytest.raises(ValueError, match=r"at most 4295 s from one frame to the next, got 5000 s .* insert frames"):
        emulate(STEP, torch.tensor([start_us, start_us + 5e9], dtype=torch.float64), config, key=1)
    with pytest.raises(ValueError, match="at most 4295 s from one frame to the next"):  # after a pause of a live camera
        emulate(STEP[:1], t_us[1:] + 5e9, config, key=1, state=state)


@MODEL_NAMES
def test_a_rotating_and_a_moving_sensor_refuse_long_steps_too(model):
    scene, rest = PolarizationScene(torch.full((3, 8, 8), 0.1)), Trajectory(3.5, 3.5, REST, REST, STILL, STILL, 0.0)
    config = of(model, render_rate_hz=2e-4)
    with pytest.raises(ValueError, match="from one frame to the next, got 5000 s"):
        emulate_motion(Camera(config, key=1), scene, rest, 5_000_000_000, (4, 4))
    slow = RotatingConfig(rate_hz=1e-6, start_angle_deg=0.0, extinction_ratio=None, frames_per_turn=32)
    with pytest.raises(ValueError, match="from one frame to the next, got 5000 s"):
        emulate_rotating(slow, Camera(config, key=1), scene, rest, 5_000_000_000, grid("four_sensors", 4, 4))


@pytest.mark.parametrize(
    "t_us", [[0.0, 2.0**63], [2.0**54, 2.0**54 + 8], [-(2.0**63), 0.0], [0.0, -1.0], [5.0, 5.0], [float("nan"), 1.0],
             [0.0, float("inf")]],
)  # fmt: skip
def test_times_that_float64_cannot_count_or_that_do_not_increase_are_refused(t_us):
    with pytest.raises(ValueError, match="strictly increasing times in us, of at most 2\\^53"):
        emulate(STEP, np.array(t_us), QUIET, key=1)


@pytest.mark.parametrize("model", ["v2e", "exact"])
def test_a_pixel_can_fire_a_million_times_in_one_step(model):
    config = of(model, leak_rate_hz=1e4, contrast_threshold_on=0.01)
    (events,), _ = emulate(STEP[:1, :, :1, :1].expand(2, 1, 1, 1), np.array([0.0, 1e8]), config, key=1)
    assert len(validate(events)) == pytest.approx(1e6, rel=1e-3)
    assert int(events.t.max()) <= 1e8


def test_shot_noise_goes_on_at_times_since_1970():
    """There float64 resolves quarters of a microsecond: a shorter wait would draw the same wait again, without end."""
    config, start_us = of("exact", shot_noise_rate_hz=1e5, refractory_period_us=100.0), 1.76e15
    pieces, state = [], None
    for k in range(3):
        (events,), state = emulate(STEP[:1], np.array([start_us + 1e5 * k]), config, key=1, state=state)
        pieces.append(events)
    assert len(concatenate(pieces)) > 9 * 1000


def test_negative_times_are_not_within_v2e_s_refractory_period():
    config = of("v2e", refractory_period_us=500.0)
    late, early = (emulate(STEP, np.array([t, t + 1e4]), config, key=1)[0][0] for t in (0.0, -1e6))
    assert (early.t + 1_000_000).tolist() == late.t.tolist()
