from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from event_fixtures import equal
from simulation_fixtures import QUIET, REST, STILL

from polarnet.config.tree import load
from polarnet.simulation import SENSORS, emulate, scene_from_polarization
from polarnet.simulation.camera import Camera, Grid
from polarnet.simulation.motion import Sine, Trajectory, resting_trajectory
from polarnet.simulation.moving_sensor import behind_polarizers, render_times_us
from polarnet.simulation.rotating import RotatingConfig, emulate_rotating
from polarnet.simulation.sets import emulate_scenes
from polarnet.storage import EventStore, SceneStore
from polarnet.storage.frames import Contents, Polarization

ROTATING = RotatingConfig(rate_hz=2.0, start_angle_deg=0.0, extinction_ratio=None, frames_per_turn=720)


def uniform_scene(s0=0.8, dolp=0.5, aolp=0.0, height=4, width=6):
    return scene_from_polarization(*(torch.full((height, width), value) for value in (s0, dolp, aolp)))


def still_events(sensor, scene, duration_us, rotating=ROTATING, height=4, width=6):
    path = resting_trajectory(height, width)
    return emulate_rotating(rotating, Camera(sensor, key=1), scene, path, duration_us, Grid(height, width))


def test_unpolarized_light_fires_nothing_and_dolp_one_half_three_events_down_and_five_each_way():
    assert len(still_events(SENSORS["clean"], uniform_scene(dolp=0.0), 1_000_000)) == 0
    # ln(1 + 0.5 cos x) falls from 0 to -0.693 and rises to 0.405; thresholds of 0.2 lie at -0.6 and 0.4.
    rotating = replace(ROTATING, start_angle_deg=45.0)
    events = still_events(QUIET, uniform_scene(), 450_000, rotating, 1, 1)  # almost a turn, two periods of the light
    assert events.p.tolist() == [-1] * 3 + [1] * 5 + [-1] * 5 + [1] * 5


def test_v2e_sees_eight_bits_of_the_light():
    sensor, scene = replace(SENSORS["clean"], model="v2e"), uniform_scene(0.1, 0.5)
    t_us = render_times_us(resting_trajectory(4, 6), 200_000, 4, 6, sensor, 1440.0)
    light = behind_polarizers(scene.stokes.numpy()[:, None].repeat(len(t_us), axis=1), ROTATING.weights(t_us))
    (expected,), _ = emulate((light[0, :, None] + 0.5).astype(np.uint8), t_us, sensor, key=1)
    events = still_events(sensor, scene, 200_000)
    assert len(events) > 100
    assert equal(events, expected)


def test_light_is_rendered_as_often_as_the_polarizer_the_sensor_and_the_motion_need():
    def times(rotation_hz, path, **changes):
        return render_times_us(path, 1_000_000, 4, 6, replace(SENSORS["clean"], **changes), rotation_hz)

    rest = resting_trajectory(4, 6)
    moving = Trajectory(600.0, 20.0, (Sine(500.0, 4.0, 0.0),), (STILL,), STILL, STILL, 2000.0)
    assert len(times(72.0, rest)) == 301  # render_rate_hz is 300
    assert len(times(1440.0, rest)) == 1441
    assert len(times(72.0, rest, render_rate_hz=None)) == pytest.approx(73, abs=1)
    adaptive = times(72.0, moving, render_rate_hz=None)
    assert np.abs(np.diff(moving.pose(adaptive * 1e-6).x)).max() < 1.01  # a pixel a step
    assert np.diff(adaptive).max() <= 1e6 / 72 + 1


def test_leaving_the_scene_and_a_rate_of_0_are_refused():
    with pytest.raises(ValueError, match="reaches rows"):
        still_events(SENSORS["clean"], uniform_scene(), 100_000, height=5)
    with pytest.raises(ValueError, match="rate_hz: expected turns per second other than 0"):
        replace(ROTATING, rate_hz=0.0)


def test_only_test_sequences_are_stored_and_a_second_run_makes_the_same(project_root, tmp_path):
    """The four channels' sensor, motion and size, with the events in the first channel."""
    config = load(project_root, ["rotating.frames_per_turn=32"])
    names = {"lake-00": "lake", "wood-00": "wood"}
    contents = Contents({"lake-00": "train", "wood-00": "test"}, {"layout": "four_sensors"})
    store = SceneStore.create(tmp_path / "scenes.zarr", contents, names, (6, 8))
    trajectory = Trajectory(12.0, 10.0, (Sine(2.0, 5.0, 0.0), STILL, STILL), REST, STILL, STILL, 10.0)
    maps = torch.rand(3, 20, 30, generator=torch.Generator().manual_seed(1))
    for name in names:
        store.write(name, Polarization(maps[0], maps[1], 3 * maps[2]), asdict(trajectory), 100_000)
    store.finish()
    arguments = tmp_path / "scenes.zarr", tmp_path / "events.zarr", config.camera, config.seed, map, 1
    assert emulate_scenes(*arguments, config.rotating) == 1
    events = EventStore.open(tmp_path / "events.zarr")
    assert events.sequences == ["wood-00"]
    first, *others = events.read("wood-00")
    assert (first.height, first.width) == (6, 8)
    assert len(first) > 0
    assert [len(channel) for channel in others] == [0, 0, 0]
    written = (tmp_path / "events.zarr" / "zarr.json").read_bytes()
    assert emulate_scenes(*arguments, config.rotating) == 1
    assert (tmp_path / "events.zarr" / "zarr.json").read_bytes() == written
    emulate_scenes(*arguments, replace(config.rotating, rate_hz=30.0))
    assert len(EventStore.open(tmp_path / "events.zarr").read("wood-00")[0]) > len(first)
