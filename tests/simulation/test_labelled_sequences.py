"""Simulated events that name their causes."""

import dataclasses

import numpy as np
import pytest
import torch

from polarnet.events.labels import LABELS, SIGNAL
from polarnet.simulation.dataset import emulate_scenes
from polarnet.simulation.motion import Sine, Trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.polarizers import IDEAL
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.readout import PERFECT
from polarnet.simulation.scene import scene_from_polarization
from polarnet.storage.events import EventStore

NOISY = dataclasses.replace(SENSORS["default"], shot_noise_rate_hz=20.0, leak_rate_hz=8.0)
STILL = Sine(0.0, 0.0, 0.0)


def clip(labels: bool, sensor=NOISY, moving: bool = True, **camera):
    shape = (60, 80)
    generator = torch.Generator().manual_seed(3)
    coarse = torch.rand(1, 3, 12, 16, generator=generator)
    s0, dolp, fraction = torch.nn.functional.interpolate(coarse, shape, mode="bilinear")[0]
    waves = ((Sine(8.0, 6.0, 0.0),), (Sine(5.0, 4.0, 1.0),)) if moving else ((STILL,), (STILL,))
    path = Trajectory(39.5, 29.5, *waves, STILL, STILL, 60.0)
    scene = scene_from_polarization(s0, dolp, 3.14 * fraction)
    return emulate_motion(scene, path, 200_000, 20, 30, sensor, 5, labels=labels, **camera)


@pytest.mark.parametrize("model", ["exact", "v2e"])
def test_labels_change_no_event_and_name_signal_leak_and_shot_noise(model):
    sensor = dataclasses.replace(NOISY, model=model)
    for plain, labelled in zip(clip(False, sensor), clip(True, sensor), strict=True):
        assert plain.label is None
        assert all(torch.equal(getattr(plain, name), getattr(labelled, name)) for name in "txyp")
        assert set(labelled.label.tolist()) == {0, 1, 2}


def test_every_event_of_a_noiseless_sensor_is_signal():
    quiet = dataclasses.replace(NOISY, shot_noise_rate_hz=0.0, leak_rate_hz=0.0)
    assert all(len(events) > 0 and (events.label == SIGNAL).all() for events in clip(True, quiet))


def test_every_event_of_a_still_scene_is_noise():
    events = clip(True, moving=False)
    assert sum(map(len, events)) > 100
    assert all((one.label != SIGNAL).all() for one in events)


def test_every_event_of_a_hot_pixel_is_named_hot():
    hot = dataclasses.replace(NOISY, hot_pixel_share=1.0, hot_pixel_rate_hz=50.0)
    assert all(len(events) > 0 and (events.label == LABELS.index("hot")).all() for events in clip(True, hot))


def test_labels_follow_their_events_through_the_readout_of_a_dofp_sensor():
    dofp = dataclasses.replace(IDEAL, layout="dofp")
    late = dataclasses.replace(PERFECT, row_latency_us=3.0, jitter_us=50.0)
    before, after = clip(True, polarizers=dofp), clip(True, polarizers=dofp, readout=late)
    for one, other in zip(before, after, strict=True):
        counts = [np.bincount(events.label, minlength=len(LABELS)) for events in (one, other)]
        assert np.abs(counts[0] - counts[1]).max() <= 2  # events of the last microseconds leave after the end
        pixels, later = (
            {*zip(e.y.tolist(), e.x.tolist(), e.p.tolist(), e.label.tolist(), strict=True)} for e in (one, other)
        )
        assert later <= pixels


def test_a_set_with_labels_holds_the_events_of_the_set_without(simulated, tmp_path):
    emulate_scenes(simulated.scenes, tmp_path / "events.zarr", simulated.camera, simulated.seed, map, 1, labels=True)
    labelled, plain = EventStore.open(tmp_path / "events.zarr"), EventStore.open(simulated.events)
    assert (labelled.labelled, plain.labelled) == (True, False)
    assert labelled.attributes == plain.attributes
    for name in plain.sequences:
        for one, other in zip(labelled.read(name), plain.read(name), strict=True):
            assert all(torch.equal(getattr(one, column), getattr(other, column)) for column in "txyp")
            assert len(one.label) == len(one)
