"""Rendering and emulation in one go give what each gives on its own."""

import dataclasses

import numpy as np
import pytest
import torch
from simulation_fixtures import REST
from skimage import data

from polarnet.events.stream import validate
from polarnet.simulation import SENSORS, Camera, emulate, scene_from_rgb
from polarnet.simulation.motion import Pose, Sine, Trajectory, render, resting_trajectory
from polarnet.simulation.moving_sensor import check_inside, emulate_motion, emulate_motion_steps, render_times_us
from polarnet.stokes import intensities_from_stokes

CONFIG = dataclasses.replace(SENSORS["default"], leak_rate_hz=0.1, shot_noise_rate_hz=1.0)
H, W = 24, 32


def trajectory(roll: float = 0.0, zoom: float = 0.0, speed: float = 150.0) -> Trajectory:
    """A sensor that swings 20 px to either side, 8 px up and down, and turns and zooms as asked."""
    x, y = (Sine(20.0, 6.0, 0.3), *REST[1:]), (Sine(8.0, 9.0, 1.1), *REST[1:])
    return Trajectory(60.3, 40.7, x, y, Sine(roll, 5.0, 0.2), Sine(zoom, 4.0, 0.4), speed_px_s=speed)


@pytest.fixture(scope="module")
def scene():
    picture = torch.from_numpy(data.coffee()[::5, ::5].copy()).permute(2, 0, 1).float() / 255
    return scene_from_rgb(picture)


def times_us(n: int = 61) -> np.ndarray:
    return np.rint(np.arange(n) * 1e6 / 300).astype(np.int64)


@pytest.mark.parametrize("model", ["v2e", "exact"])
@pytest.mark.parametrize("turning", [False, True])
def test_events_are_those_of_the_rendered_clip(scene, model, turning):
    path, config = trajectory(roll=0.3 * turning, zoom=0.2 * turning), dataclasses.replace(CONFIG, model=model)
    frames = 255 * intensities_from_stokes(render(scene, path, times_us() * 1e-6, H, W)).clamp(0, 1)
    if model == "v2e":
        frames = (frames + 0.5).to(torch.uint8)
    expected, _ = emulate(frames, torch.from_numpy(times_us()), config, key=5)
    events, _ = emulate_motion_steps(Camera(config, key=5), scene, path, times_us(), (H, W))
    for ours, theirs in zip(events, expected, strict=True):
        validate(ours)
        assert len(theirs) > 1000
        a, b = ({*zip(e.t.tolist(), e.x.tolist(), e.y.tolist(), e.p.tolist(), strict=True)} for e in (ours, theirs))
        # light that differs in its last bit moves few stamps by a microsecond, and fewer pixels across a rounding
        assert len(a & b) > 0.97 * len(b)
        assert len(ours) == pytest.approx(len(theirs), rel=2e-3)


def test_v2e_renders_at_regular_times_and_exact_when_pixels_meet():
    config = dataclasses.replace(CONFIG, model="v2e")
    assert render_times_us(trajectory(), 100_000, H, W, config).tolist() == [round(k * 1e6 / 300) for k in range(31)]
    config = dataclasses.replace(config, render_rate_hz=100.0)
    assert render_times_us(trajectory(), 25_000, H, W, config).tolist() == [0, 10_000, 20_000, 25_000]
    t_us = render_times_us(resting_trajectory(H, W), 1_000_000, H, W, dataclasses.replace(CONFIG, render_rate_hz=None))
    assert np.diff(t_us) == pytest.approx(1e6 / 30, abs=1)
    t_us = render_times_us(trajectory(), 200_000, H, W, CONFIG)
    assert len(t_us) == 61
    assert (t_us[0], t_us[-1]) == (0, 200_000)
    assert abs(t_us - times_us()).max() <= 1e6 / 300 / 2
    moved = np.flatnonzero(t_us != times_us())
    pose = trajectory().pose(t_us[moved] * 1e-6)
    off_grid = [abs(place - np.rint(place)) for place in (pose.x - (W - 1) / 2, pose.y - (H - 1) / 2)]
    assert len(moved) > 15
    assert np.minimum(*off_grid).max() < 1e-3


@pytest.mark.parametrize("model", ["v2e", "exact"])
def test_an_adaptive_rate_takes_steps_of_at_most_a_pixel(model):
    config = dataclasses.replace(CONFIG, model=model, render_rate_hz=None)
    path = trajectory(roll=0.3, zoom=0.2, speed=250.0)
    for motion in (path, trajectory()):
        t_us = render_times_us(motion, 500_000, H, W, config)
        pose = motion.pose(t_us * 1e-6)
        corner = np.hypot(H - 1, W - 1) / 2
        moved = np.hypot(np.diff(pose.x), np.diff(pose.y)) * pose.zoom[1:]
        assert moved.max() <= 1.01 + corner * (abs(np.diff(pose.angle)).max() + abs(np.diff(pose.zoom)).max())
        assert np.diff(t_us).max() <= 1e6 / 30 + 1
        assert (t_us[0], t_us[-1]) == (0, 500_000)


def test_a_sensor_as_large_as_the_scene_fits_and_one_that_leaves_it_is_refused_with_its_place(scene):
    pose = Pose(np.array([59.5]), np.array([39.5]), np.zeros(1), np.ones(1))
    check_inside(scene, pose, np.zeros(1, np.int64), 80, 120)
    for x, y in ((59.6, 39.5), (59.4, 39.5), (59.5, 39.6), (59.5, 39.4)):
        with pytest.raises(ValueError, match="at 7 us a sensor of 80x120 pixels reaches"):
            check_inside(scene, pose._replace(x=np.array([x]), y=np.array([y])), np.array([7]), 80, 120)
    far = dataclasses.replace(trajectory(), x=100.0)
    with pytest.raises(ValueError, match=r"reaches rows .* of a scene of 80x120; use a trajectory made for this scene"):
        emulate_motion(Camera(CONFIG), scene, far, 200_000, (H, W))
