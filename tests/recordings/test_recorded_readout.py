"""Signs of a readout in recordings: simulated ones, whose readout is known, and real files."""

import functools
import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events, concatenate
from polarnet.recordings.inspection import Inspection, inspect_recording
from polarnet.recordings.readout import Readout, ReadoutSigns, readout_findings
from polarnet.recordings.recording import open_recording
from polarnet.simulation import BUILTIN_PHOTOS, SENSORS, read_rgb, scene_from_rgb
from polarnet.simulation.camera import Camera
from polarnet.simulation.emulator import emulate
from polarnet.simulation.motion import Sine, Trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.readout import PERFECT, read_out
from polarnet.simulation.scene import PolarizationScene

HEIGHT, WIDTH, DURATION_US = 60, 80, 1_000_000
MODELS = ("exact", "v2e", "esim")
STILL = Sine(0.0, 0.0, 0.0)


@functools.cache
def photograph() -> PolarizationScene:
    return scene_from_rgb(read_rgb(BUILTIN_PHOTOS[2].path))


@functools.cache
def moving(model: str) -> Events:
    """A sensor that swings over a photograph: its event rate rises and falls."""
    path = Trajectory(300.0, 200.0, (Sine(60.0, 8.0, 0.0),), (Sine(30.0, 5.0, 1.0),), STILL, STILL, 630.0)
    config = replace(SENSORS["default"], model=model)
    return emulate_motion(Camera(config, key=1), photograph(), path, DURATION_US, (HEIGHT, WIDTH))[0]


@functools.cache
def flickering(model: str) -> Events:
    """A grey card under a lamp of 20 Hz."""
    t_us = np.arange(0, DURATION_US + 1, 1000)
    light = torch.from_numpy(60 * np.exp(0.6 * np.sin(2 * math.pi * 20e-6 * t_us))).float()
    frames = light[:, None, None, None].expand(-1, 1, HEIGHT, WIDTH)
    return emulate(frames, torch.from_numpy(t_us), replace(SENSORS["default"], model=model), key=3)[0][0]


def selected(events: Events, keep: np.ndarray) -> Events:
    columns = (column[torch.from_numpy(keep)] for column in (events.t, events.x, events.y, events.p))
    return Events(*columns, events.height, events.width)


def signs_of(*parts: Events) -> Readout:
    signs = ReadoutSigns(parts[0].height, parts[0].width)
    for part in parts:
        signs.add(part)
    events = concatenate(parts)
    pixel = events.y.long() * events.width + events.x.long()
    counts = torch.bincount(pixel, minlength=events.height * events.width).numpy()
    return signs.result(counts.reshape(events.height, events.width))


@pytest.mark.parametrize("scene", [moving, flickering])
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("share", [0.6, 0.25])
def test_a_readout_that_carries_a_part_of_the_events_is_at_its_limit(scene, model, share):
    rate_hz = share * len(scene(model))  # in one second
    config = replace(PERFECT, max_events_per_s=rate_hz, max_wait_us=5000.0)
    recorded, lost = read_out(scene(model), config, key=1, duration_us=DURATION_US)
    assert lost > 0
    limit = signs_of(recorded).limit
    assert limit is not None
    assert limit.unit == "events"
    assert limit.rate_hz == pytest.approx(rate_hz, rel=0.02)


@pytest.mark.parametrize("scene", [moving, flickering])
@pytest.mark.parametrize("model", MODELS)
def test_a_perfect_readout_raises_no_alarm(scene, model):
    signs = signs_of(scene(model))
    assert (signs.limit, signs.lost_rows, signs.gap.unusual) == (None, None, False)


@pytest.mark.parametrize("scene", [moving, flickering])
@pytest.mark.parametrize("model", ["exact", "esim"])
def test_a_readout_that_is_fast_enough_shows_no_limit(scene, model):
    """Not for `v2e`: its events come in step with the frames, and fill any readout for a moment."""
    config = replace(PERFECT, max_events_per_s=20.0 * len(scene(model)), max_wait_us=5000.0)
    recorded, lost = read_out(scene(model), config, key=1, duration_us=DURATION_US)
    assert lost == 0
    assert signs_of(recorded).limit is None


@pytest.mark.parametrize("sensor", ["clean", "noisy"])
def test_motion_at_constant_speed_shows_no_limit(sensor):
    line = Trajectory(300.0, 200.0, (Sine(2000.0, 0.1, 0.0),), (Sine(0.0, 0.0, 0.0),), STILL, STILL, 200.0)
    events = emulate_motion(Camera(SENSORS[sensor], key=1), photograph(), line, DURATION_US, (HEIGHT, WIDTH))[0]
    signs = signs_of(events)
    assert signs.limits_judged
    assert (signs.limit, signs.lost_rows, signs.sweep) == (None, None, None)


def test_the_time_at_the_limit_is_that_of_a_queue():
    """A quarter of a second of the events, four times as fast: the bus needs that second to carry them."""
    events = moving("exact")
    fast = Events(events.t // 4, events.x, events.y, events.p, HEIGHT, WIDTH)
    config = replace(PERFECT, max_events_per_s=float(len(events)), max_wait_us=1e9)
    recorded, lost = read_out(fast, config, key=1, duration_us=2 * DURATION_US)
    assert lost == 0
    assert signs_of(recorded).limit.time_share > 0.95


def test_rows_missing_in_busy_moments_are_named():
    events = moving("exact")
    moment = events.t.numpy() // 10_000
    busy = np.bincount(moment) > np.median(np.bincount(moment))
    missing = busy[moment] & np.isin(events.y.numpy(), (20, 21, 40))
    lost = signs_of(selected(events, ~missing)).lost_rows
    assert lost.rows.tolist() == [20, 21, 40]
    assert lost.cases > 20


def test_rows_that_are_always_dark_are_not_lost_but_empty():
    events = moving("exact")
    signs = signs_of(selected(events, ~np.isin(events.y.numpy(), (20, 21, 40))))
    assert signs.lost_rows is None
    assert signs.empty_rows.tolist() == [20, 21, 40]
    assert "empty rows  3 of 60 without any event: 20-21, 40" in list(readout_findings(signs, HEIGHT))


@pytest.mark.parametrize("latency_us", [2.0, 10.0])
def test_rows_read_one_after_another_show_their_delay_when_many_pixels_change_at_once(latency_us):
    late, _ = read_out(moving("v2e"), replace(PERFECT, row_latency_us=latency_us), key=1, duration_us=DURATION_US)
    sweep = signs_of(late).sweep
    assert (sweep.axis, sweep.rising) == ("rows", True)
    assert sweep.delay_us == pytest.approx(latency_us, rel=0.1)
    assert signs_of(moving("v2e")).sweep is None


def test_a_gap_is_far_longer_than_the_other_silences():
    events = moving("exact")
    t = events.t.numpy()
    gap = signs_of(selected(events, (t < 300_000) | (t >= 340_000))).gap
    assert gap.unusual
    assert (gap.start_us, gap.duration_us) == pytest.approx((300_000, 40_000), abs=300)


def test_the_signs_do_not_depend_on_how_the_recording_is_cut():
    config = replace(PERFECT, max_events_per_s=2e4, max_wait_us=5000.0)
    events, _ = read_out(moving("v2e"), config, key=1, duration_us=DURATION_US)
    t = events.t.numpy()
    cuts = [0, *(np.searchsorted(t, t[k]) for k in (1000, 1700, 9000)), len(t)]
    parts = [selected(events, (np.arange(len(t)) >= a) & (np.arange(len(t)) < b)) for a, b in itertools.pairwise(cuts)]
    assert list(readout_findings(signs_of(*parts), HEIGHT)) == list(readout_findings(signs_of(events), HEIGHT))


def inspected(folder: Path, name: str, **size: int) -> Inspection:
    path = folder / "data" / "recordings" / name
    return inspect_recording(open_recording(path, chunk_events=100_000, **size), hot_pixel_factor=4)


def test_a_driving_sequence_of_a_prophesee_camera_keeps_its_readout_busy(shared):
    """In each of the 8,802 microseconds of the file six or seven rows are read, with any number of events."""
    limit = inspected(shared, "prophesee/evt3_sample.raw").readout.limit
    assert limit.unit == "rows"
    assert limit.rate_hz == pytest.approx(6.775e6, rel=0.01)
    assert limit.time_share > 0.9


def test_a_camera_that_reads_columns_in_turn_is_recognised(shared):
    signs = inspected(shared, "aedat4/tonic_sample.aedat4").readout
    assert (signs.sweep.axis, signs.sweep.rising) == ("columns", False)
    assert 190 < 320 * signs.sweep.delay_us < 200  # its scans repeat every 197 us
    assert (signs.limit, signs.lost_rows) == (None, None)


def test_other_real_files_raise_no_false_alarm(shared):
    for name, size in (("prophesee/evt2.raw", {}), ("prophesee/sample_ncars.dat", {"height": 240, "width": 304})):
        signs = inspected(shared, name, **size).readout
        assert (signs.limit, signs.sweep, signs.lost_rows, signs.gap.unusual) == (None, None, None, False)


def test_the_start_of_a_simulated_camera_is_not_its_busiest_moment(shared):
    """Nearly all 76,800 pixels of this file fire ON at time 0; its times are whole milliseconds."""
    inspection = inspected(shared, "event_stream/dvs.es")
    assert inspection.start_events == 76_785
    assert inspection.peak_us == 10_000
    assert inspection.peak_rate_hz == pytest.approx(470e3, rel=0.01)
    assert (inspection.busiest != 0).any(axis=1).sum() > 80
    assert not inspection.readout.limits_judged
