"""Trajectories keep their promises for all times, and the window sees what the scene holds."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from simulation_fixtures import REST

from polarnet.simulation import MOTIONS, PolarizationScene, scene_from_polarization, scene_from_rgb
from polarnet.simulation.motion import Sine, SynthesizeConfig, Trajectory, frame_times_us, random_trajectory, render
from polarnet.stokes import aolp, dolp

CONFIG = dataclasses.replace(MOTIONS["default"], sequences_per_picture=1, speed_min_px_s=60.0, speed_max_px_s=200.0)


@pytest.fixture(scope="module")
def scene() -> PolarizationScene:
    return scene_from_rgb(torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(0)))


def still(x: float, y: float, roll: float = 0.0, zoom: float = 1.0) -> Trajectory:
    """A window that stays where it is."""
    turn = Sine(roll, 0.0, math.pi / 2), Sine((zoom - 1) / 2, 0.0, math.pi / 2)
    return Trajectory(x, y, REST, REST, *turn, speed_px_s=0.0)


def corners(trajectory: Trajectory, config: SynthesizeConfig, t_s: np.ndarray) -> np.ndarray:
    """Points of the scene, x + iy, under the four corner pixels of the window; the definition, written anew."""
    pose = trajectory.pose(t_s)
    half_width, half_height = (config.sensor_width - 1) / 2, (config.sensor_height - 1) / 2
    offsets = np.array([sx * half_width + 1j * sy * half_height for sx in (-1, 1) for sy in (-1, 1)])
    return pose.x + 1j * pose.y + offsets[:, None] * np.exp(1j * pose.angle) / pose.zoom


configs = st.builds(
    lambda low, ratio, **values: dataclasses.replace(CONFIG, speed_min_px_s=low, speed_max_px_s=low * ratio, **values),
    st.floats(10, 100), st.floats(1, 4), acceleration_max_px_s2=st.floats(500, 5000),
    rotation_max_deg=st.sampled_from([0.0, 5.0, 45.0, 90.0]), zoom_max=st.sampled_from([1.0, 1.2, 4.0]),
    sensor_width=st.integers(60, 180),
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(config=configs, seed=st.integers(0, 2**32))
def test_no_pixel_of_the_window_ever_leaves_the_scene_or_exceeds_speed_or_acceleration(config, seed):
    height, width = 400, 600
    trajectory = random_trajectory(config, height, width, np.random.default_rng(seed))
    step = 1e-4
    for start in (-3.0, 0.0, 40.0):  # the promise is for all times, not only for the sequence
        points = corners(trajectory, config, np.arange(start, start + 1, step))
        assert 0 <= points.real.min() <= points.real.max() <= width - 1
        assert 0 <= points.imag.min() <= points.imag.max() <= height - 1
        assert np.abs(np.diff(points)).max() / step <= trajectory.speed_px_s * (1 + 1e-6)
        acceleration = np.abs(np.diff(points, 2)).max() / step**2
        assert acceleration <= config.acceleration_max_px_s2 * 1.0001 + 0.1  # 0.1: rounding of second differences
    assert trajectory.speed_px_s <= config.speed_max_px_s


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_the_drawn_peak_speed_is_really_reached_within_the_sequence(seed):
    trajectory = random_trajectory(CONFIG, 400, 600, np.random.default_rng(seed))
    t_s = np.linspace(0, 1, 10001)
    pose = trajectory.pose(t_s)
    peak = np.hypot(np.diff(pose.x), np.diff(pose.y)).max() * 10000
    assert peak == pytest.approx(trajectory.speed_px_s, rel=1e-3)
    assert CONFIG.speed_min_px_s <= trajectory.speed_px_s <= CONFIG.speed_max_px_s


def test_a_trajectory_survives_the_way_through_json_to_the_last_bit():
    config = dataclasses.replace(CONFIG, rotation_max_deg=10.0, zoom_max=1.5)
    trajectory = random_trajectory(config, 400, 600, np.random.default_rng(0))
    record = json.loads(json.dumps(dataclasses.asdict(trajectory)))
    assert Trajectory.from_record(record) == trajectory
    with pytest.raises(ValueError, match="roll"):
        Trajectory.from_record({**record, "roll": None})


def test_a_scene_too_small_for_the_window_is_refused_and_a_small_one_lowers_the_speed():
    with pytest.raises(ValueError, match=r"scene of 120x300 .* too small: a sensor of 120x180 .* more than 120x180"):
        random_trajectory(CONFIG, 120, 300, np.random.default_rng(0))
    rolled = dataclasses.replace(CONFIG, rotation_max_deg=90.0)
    with pytest.raises(ValueError, match="more than 216x216"):  # the sensor's diagonal
        random_trajectory(rolled, 215, 600, np.random.default_rng(0))
    # With 20 pixels of room and 800 px/s^2, sqrt(800 * 20 / 2) = 126 px/s is about the most.
    speeds = [random_trajectory(CONFIG, 140, 200, np.random.default_rng(seed)).speed_px_s for seed in range(50)]
    assert min(speeds) >= 60
    assert max(speeds) < 150


def test_a_frame_lies_at_both_ends_of_every_window():
    times = frame_times_us(CONFIG)
    assert len(times) == 31
    assert times[:3] == [0, 33333, 66667]
    assert times[-1] == 1_000_000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed_max_px_s": 50.0}, "speed_max_px_s: expected >= speed_min_px_s 60"),
        ({"duration_s": 0.01}, "duration_s: expected at least one frame"),
    ],
)
def test_a_bad_setting_is_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(CONFIG, **changes)


# -- what the window sees ----------------------------------------------------------------------------------------------


def test_a_window_at_whole_pixels_sees_exactly_those_pixels_and_with_zoom_2_every_second_is_one(scene):
    for top, left in ((0, 0), (7, 11), (40, 50)):
        frame = render(scene, still(left + 29 / 2, top + 19 / 2), np.zeros(1), 20, 30)[0]
        assert torch.equal(frame, scene.stokes[:, top : top + 20, left : left + 30])
    frame = render(scene, still(40.0, 30.0, zoom=2.0), np.zeros(1), 21, 31)[0]
    torch.testing.assert_close(frame[:, ::2, 1::2], scene.stokes[:, 25:36, 33:48])


@pytest.mark.parametrize("roll_deg", [-20.0, 0.0, 20.0, 90.0])
def test_a_bar_at_30_degrees_polarized_along_itself_stays_so_while_the_camera_rolls(roll_deg):
    """Angles count anticlockwise; the camera rolls clockwise, so that it sees both turned by as much."""
    y, x = torch.meshgrid(torch.arange(61.0) - 30, torch.arange(81.0) - 40, indexing="ij")
    across = x * math.sin(math.radians(30)) + y * math.cos(math.radians(30))
    bar = scene_from_polarization(
        torch.exp(-(across**2) / 20), torch.full_like(x, 0.75), torch.full_like(x, math.pi / 6)
    )
    frame = render(bar, still(40.0, 30.0, roll=math.radians(roll_deg)), np.zeros(1), 41, 41)[0].double()
    y, x = y[10:51, 20:61], x[10:51, 20:61]
    weight = frame[0] * (x**2 + y**2 <= 400)
    bar_deg = math.degrees(math.atan2(-2 * float((weight * x * y).sum()), float((weight * (x**2 - y**2)).sum()))) / 2
    assert bar_deg % 180 == pytest.approx((30 + roll_deg) % 180, abs=0.3)
    assert math.degrees(aolp(frame)[20, 20]) == pytest.approx((30 + roll_deg) % 180, abs=1e-3)
    torch.testing.assert_close(dolp(frame), torch.full((41, 41), 0.75, dtype=torch.float64), atol=1e-5, rtol=0)
