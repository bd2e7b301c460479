import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from polarnet.config.tree import load
from polarnet.simulation.motion import Sine, Trajectory
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.rotating import (
    RotatingConfig,
    behind_rotating_polarizer,
    emulate_rotating,
    emulate_rotating_scenes,
    rotating_times_us,
)
from polarnet.simulation.scene import scene_from_polarization
from polarnet.storage.events import EventStore
from polarnet.storage.frames import Contents
from polarnet.storage.scenes import Scene, SceneStore

ROTATING = RotatingConfig(rate_hz=2.0, start_angle_deg=0.0, extinction_ratio=None, frames_per_turn=720)


def uniform_scene(s0=0.8, dolp=0.5, aolp=0.0, height=4, width=6):
    return scene_from_polarization(*(torch.full((height, width), value) for value in (s0, dolp, aolp)))


def columns(events):
    return [getattr(events, name).tolist() for name in ("t", "x", "y", "p")]


def test_malus_law_along_at_45_degrees_and_across_the_axis():
    stokes = uniform_scene(1.0, 1.0, math.radians(30)).stokes.expand(3, -1, -1, -1)
    light = behind_rotating_polarizer(stokes, np.radians([30.0, 75.0, 120.0]), None)
    assert light[:, 0, 0].tolist() == pytest.approx([1.0, 0.5, 0.0], abs=1e-6)


def test_a_100_to_1_film_shows_99_of_101_parts_of_full_polarization():
    stokes = uniform_scene(1.0, 1.0).stokes.expand(2, -1, -1, -1)
    along, across = behind_rotating_polarizer(stokes, np.radians([0.0, 90.0]), 100.0)[:, 0, 0].tolist()
    assert (along - across) / (along + across) == pytest.approx(99 / 101, abs=1e-6)


def test_unpolarized_light_fires_nothing_behind_a_rotating_polarizer():
    t_us = rotating_times_us(ROTATING, SENSORS["clean"], 0, 1_000_000)
    assert len(emulate_rotating(uniform_scene(dolp=0.0), None, t_us, 4, 6, ROTATING, SENSORS["clean"], 1).events) == 0


def test_dolp_one_half_fires_three_events_down_from_its_mean_and_five_on_each_way_between_its_extremes():
    """ln(1 + 0.5 cos x) falls from 0 to -0.693 and rises to 0.405; thresholds of 0.2 lie at -0.6 and 0.4."""
    sensor = replace(SENSORS["clean"], contrast_threshold_sigma_on=0.0, contrast_threshold_sigma_off=0.0)
    rotating = replace(ROTATING, start_angle_deg=45.0)
    t_us = rotating_times_us(rotating, sensor, 0, 450_000)  # a little less than one turn, two periods of the light
    p = emulate_rotating(uniform_scene(), None, t_us, 1, 1, rotating, sensor, 1).events.p.tolist()
    assert p == [-1] * 3 + [1] * 5 + [-1] * 5 + [1] * 5


def test_a_span_in_pieces_gives_the_events_of_the_whole_span():
    sensor, scene = SENSORS["noisy"], uniform_scene()
    t_us = rotating_times_us(ROTATING, sensor, 0, 300_000)
    whole = emulate_rotating(scene, None, t_us, 4, 6, ROTATING, sensor, 3).events
    first = emulate_rotating(scene, None, t_us[:150], 4, 6, ROTATING, sensor, 3)
    second = emulate_rotating(scene, None, t_us[150:], 4, 6, ROTATING, sensor, 3, first.state)
    pieces = [a + b for a, b in zip(columns(first.events), columns(second.events), strict=True)]
    assert pieces == columns(whole)


def test_light_is_rendered_as_often_as_the_polarizer_and_the_sensor_need():
    slow = RotatingConfig(rate_hz=-0.1, start_angle_deg=0.0, extinction_ratio=None, frames_per_turn=720)
    assert len(rotating_times_us(slow, SENSORS["clean"], 0, 1_000_000)) == 301  # render_rate_hz is 300
    assert len(rotating_times_us(ROTATING, SENSORS["clean"], 0, 1_000_000)) == 1441


def test_a_resting_trajectory_equals_none_and_leaving_the_scene_is_refused():
    still, sensor = Sine(0.0, 0.0, 0.0), SENSORS["clean"]
    t_us = rotating_times_us(ROTATING, sensor, 0, 100_000)
    rest = Trajectory(2.5, 1.5, (still,), (still,), still, still, 0.0)
    with_rest, without = (
        emulate_rotating(uniform_scene(), path, t_us, 4, 6, ROTATING, sensor, 1).events for path in (rest, None)
    )
    assert columns(with_rest) == columns(without)
    with pytest.raises(ValueError, match="reaches rows"):
        emulate_rotating(uniform_scene(), replace(rest, x=9.0), t_us, 4, 6, ROTATING, sensor, 1)
    with pytest.raises(ValueError, match="exceeds the scene"):
        emulate_rotating(uniform_scene(), None, t_us, 5, 6, ROTATING, sensor, 1)


def test_a_rate_of_0_is_refused():
    with pytest.raises(ValueError, match="rate_hz: expected turns per second other than 0"):
        replace(ROTATING, rate_hz=0.0)


def test_only_test_sequences_are_stored_and_a_second_run_keeps_the_store(project_root, tmp_path):
    """The four channels' sensor, motion and size, with the events in the first channel."""
    config = load(project_root, ["rotating.frames_per_turn=32"])
    names = {"lake-00": "lake", "wood-00": "wood"}
    store = SceneStore.create(
        tmp_path / "scenes.zarr", Contents({"lake-00": "train", "wood-00": "test"}, {"layout": "four_sensors"}), names,
        largest_picture=(20, 30), sensor=(6, 8), trajectory_names=Trajectory.vector_names(),
    )  # fmt: skip
    still = Sine(0.0, 0.0, 0.0)
    trajectory = Trajectory(12.0, 10.0, (Sine(2.0, 5.0, 0.0), still, still), (still, still, still), still, still, 10.0)
    maps = torch.rand(3, 20, 30, generator=torch.Generator().manual_seed(1))
    for name in names:
        store.write(name, Scene(maps[0], maps[1], 3 * maps[2]), trajectory.to_vector(), 100_000)
    store.finish()
    arguments = tmp_path / "scenes.zarr", tmp_path / "events.zarr", config.rotating, config.camera, config.seed, map
    assert emulate_rotating_scenes(*arguments) == 1
    events = EventStore.open(tmp_path / "events.zarr")
    assert events.sequences == ["wood-00"]
    first, *others = events.read("wood-00")
    assert (first.height, first.width) == (6, 8)
    assert len(first) > 0
    assert [len(channel) for channel in others] == [0, 0, 0]
    written_ns = (tmp_path / "events.zarr" / "zarr.json").stat().st_mtime_ns
    assert emulate_rotating_scenes(*arguments) == 1
    assert (tmp_path / "events.zarr" / "zarr.json").stat().st_mtime_ns == written_ns
    faster = replace(config.rotating, rate_hz=30.0)
    emulate_rotating_scenes(*arguments[:2], faster, *arguments[3:])
    assert len(EventStore.open(tmp_path / "events.zarr").read("wood-00")[0]) > len(first)
