import dataclasses

import pytest
import torch

from polarnet.analysis.resimulate import resimulated, sequence_at
from polarnet.analysis.sensitivity import CHANNEL_SIGNS, SETTINGS, Emulation, sensitivity
from polarnet.config.tree import load
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.pictures.images import write_png
from polarnet.pictures.manifest import Manifest, ManifestEntry, write_manifest
from polarnet.runtime.machine import generator_for
from polarnet.simulation.camera import Camera
from polarnet.simulation.dataset import emulate_scenes
from polarnet.simulation.motion import Trajectory
from polarnet.simulation.truth import Synthesis, synthesize
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.scenes import SceneStore

SMALL = [
    "synthesize.duration_s=0.2", "synthesize.sensor_height=60", "synthesize.sensor_width=90",
    "synthesize.speed_min_px_s=20.0", "synthesize.speed_max_px_s=40.0",
]  # fmt: skip


@pytest.fixture(scope="module")
def config(project_root):
    return load(project_root, SMALL)


@pytest.fixture(scope="module")
def stores(tmp_path_factory, config):
    """One dead-leaves picture, one sequence: scenes, frames, events."""
    root = tmp_path_factory.mktemp("stores")
    images = root / "images"
    images.mkdir()
    write_png(images / "leaf.png", dead_leaves(generator_for(1, "leaf", "picture"), 200, 300), bits=8)
    entry = ManifestEntry(
        name="leaf", file="leaf.png", split="test", source="dead_leaves", origin="", sha256="0" * 64, bits=8,
        height=200, width=300, source_height=200, source_width=300,
    )  # fmt: skip
    write_manifest(Manifest((entry,), (), 0, 0), images)
    synthesize(Synthesis(images, config.synthesize, config.seed, 2), root / "scenes.zarr", root / "frames.zarr", map)
    emulate_scenes(root / "scenes.zarr", root / "events.zarr", config.camera, config.seed, map, 1)
    opened = SceneStore.open(root / "scenes.zarr"), FrameStore.open(root / "frames.zarr")
    return *opened, EventStore.open(root / "events.zarr")


def test_the_same_sensor_and_speed_give_the_stored_sequence_again(stores, config):
    scenes, frames, events = stores
    again = resimulated(scenes, "leaf-00", config.synthesize, [config.camera] * 4, config.seed)
    for events_again, stored in zip(again.events, events.read("leaf-00"), strict=True):
        assert torch.equal(events_again.t, stored.t)
        assert torch.equal(events_again.x, stored.x)
    torch.testing.assert_close(again.dolp, frames.dolp("leaf-00")[1:], atol=1e-5, rtol=0)


def test_truth_at_any_time_lies_between_that_of_the_frames(stores):
    scenes, frames, events = stores
    t_us = frames.t_us("leaf-00")
    result = sequence_at(scenes, "leaf-00", events.read("leaf-00"), t_us)
    torch.testing.assert_close(result.dolp, frames.dolp("leaf-00")[1:], atol=1e-5, rtol=0)
    finer = sequence_at(scenes, "leaf-00", events.read("leaf-00"), torch.arange(0, int(t_us[-1]) + 1, 5000))
    assert len(finer.dolp) == int(t_us[-1]) // 5000


def test_an_error_of_one_channel_changes_the_events_behind_that_polarizer_alone(stores, config):
    scenes, _, events = stores
    stored = events.read("leaf-00")
    higher = dataclasses.replace(config.emulate, contrast_threshold_on=0.4, contrast_threshold_off=0.4)
    channels = resimulated(
        scenes, "leaf-00", config.synthesize, [Camera(higher), *[config.camera] * 3], config.seed
    ).events  # fmt: skip
    assert len(channels[0]) < 0.8 * len(stored[0])
    for k in (1, 2, 3):
        assert torch.equal(channels[k].t, stored[k].t)


def test_twice_the_speed_is_twice_the_speed(stores, config, monkeypatch):
    scenes = stores[0]
    speeds = []

    def noting(*arguments):
        trajectory = arguments[2]
        speeds.append(trajectory.speed_px_s)
        return list(stores[2].read("leaf-00"))

    monkeypatch.setattr("polarnet.analysis.resimulate.emulate_motion", noting)
    resimulated(scenes, "leaf-00", config.synthesize, [config.camera] * 4, config.seed, speed=2.0)
    stored = Trajectory.from_vector(scenes.read("leaf-00").trajectory.numpy())
    assert speeds == [pytest.approx(2 * stored.speed_px_s, rel=1e-6)]


def test_channel_errors_are_opposite_in_each_pair_of_polarizers(config):
    cameras = Emulation(config.synthesize, config.camera, config.seed).cameras
    result = cameras("channel_error", 0.1, "leaf-00")
    assert [s.sensor.contrast_threshold_on for s in result] == pytest.approx([0.22, 0.18, 0.18, 0.22])
    assert CHANNEL_SIGNS[0] == -CHANNEL_SIGNS[2]
    assert CHANNEL_SIGNS[1] == -CHANNEL_SIGNS[3]
    assert {s.sensor.shot_noise_rate_hz for s in cameras("noise_rate_hz", 5.0, "leaf-00")} == {5.0}
    with pytest.raises(ValueError, match="expected one of threshold_mismatch"):
        cameras("colour", 1.0, "leaf-00")


def test_each_setting_and_value_is_scored_for_each_method(stores, config, context):
    settings = {"noise_rate_hz": (0.0, 20.0), "speed": (1.0,)}
    emulation = Emulation(config.synthesize, config.camera, 1)
    table = sensitivity(stores[0], ["leaf-00"], emulation, ["zeros", "cf"], context, 1, settings)
    quiet, noisy = table["noise_rate_hz"]
    assert noisy["events_per_pixel_second"] > quiet["events_per_pixel_second"] + 5
    assert quiet["scores"]["zeros"] == noisy["scores"]["zeros"]  # the truth does not change with the sensor
    assert quiet["scores"]["cf"] != noisy["scores"]["cf"]
    assert table["speed"][0]["sequences"] == 1
    assert set(SETTINGS) == {"threshold_mismatch", "noise_rate_hz", "speed", "channel_error"}
