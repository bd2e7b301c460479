"""The simulated rig end to end: eight files, their start times, the ground truth, the stores, the benchmark."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from polarnet import stokes
from polarnet.benchmark.run import run_benchmark
from polarnet.captures.dot import RecordingsConfig, find_captures
from polarnet.captures.targets import calibrate_targets
from polarnet.config.pipeline import context_of, made_set
from polarnet.config.tree import load
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.reports.recordings import draw_calibration
from polarnet.simulation.motion import render
from polarnet.simulation.scene import scene_from_rgb
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from studies.simulated_rig import PICTURE_RATE_HZ, RigConfig, write_rig

pytestmark = pytest.mark.thorough

SMALL = {"enabled": True, "sensor": [96, 160], "region": [24, 2], "negative_events": 24, "crop": [64, 96],
         "size": [16, 24]}  # fmt: skip
RIG = RigConfig(speed_px_s=80.0, longest_delay_s=0.25, duration_s=0.3, hot_pixels=3)


def true_dolp(truth, t_us, recordings):
    """DoLP of the noiseless intensities of the reduced crop; times count from the landmark."""
    (height, width), (top, left) = recordings.crop, recordings.crop_corner
    # offset from the centre of the sensor to the centre of the crop
    right, down = left + (width - recordings.sensor[1]) / 2, top + (height - recordings.sensor[0]) / 2
    path = replace(truth.path, x=truth.path.x + right, y=truth.path.y + down)
    frames = render(truth.scene, path, (t_us + truth.landmark_us) * 1e-6, height, width)
    intensities = stokes.intensities_from_stokes(frames).clamp(0, 1)
    small = torch.nn.functional.adaptive_avg_pool2d(intensities, (recordings.size[0], recordings.size[1]))
    return stokes.dolp(stokes.stokes_from_intensities(small)).clamp(0, 1)


def spread_us(starts, others):
    """Differences between two sets of start times, minus their mean: the zero of the clock is a convention."""
    differences = np.array([starts[c] - others[c] for c in starts], float)
    return (differences - differences.mean()).tolist()


@pytest.fixture(scope="module")
def config(project_root) -> RecordingsConfig:
    return replace(load(project_root).recordings, **SMALL)


@pytest.fixture(scope="module")
def rig(project_root, config, tmp_path_factory):
    """A folder with one target, and what is true of it."""
    root = tmp_path_factory.mktemp("rig")
    emulator = replace(load(project_root).emulate, model="exact", cutoff_hz=3000.0)
    picture = dead_leaves(np.random.default_rng(3), 96, 200)
    scene = scene_from_rgb(torch.from_numpy(picture).permute(2, 0, 1) * 0.85 + 0.1)
    return root, write_rig(root / "one", scene, RIG, config, emulator, seed=1)


@pytest.fixture(scope="module")
def calibrated(rig, config, tmp_path_factory):
    root, truth = rig
    folder = tmp_path_factory.mktemp("calibrated")
    (found,) = calibrate_targets([root / "one"], folder / "out", config, {})
    return folder / "out", found, truth


def test_the_rig_writes_eight_captures_whose_events_are_calibrated(rig, calibrated, config):
    events = EventStore.open(calibrated[0] / "events.zarr")
    assert (events.height, events.width) == tuple(config.size)
    assert min(events.count("one")) > 0
    root, truth = rig
    assert len(find_captures(root / "one")) == 8
    assert len(set(truth.start_us.values())) == 8  # random delays
    assert all(80_000 <= start <= 250_000 for start in truth.start_us.values())


def test_start_times_by_the_landmark_are_refined_within_a_millisecond_and_thresholds_and_hot_pixels_found(calibrated):
    _, found, truth = calibrated
    for capture, start in truth.start_us.items():
        assert abs(found.landmark_us[capture] - start) <= 1e6 / PICTURE_RATE_HZ, capture
    by_landmark = np.abs(spread_us(found.landmark_us, truth.start_us)).max()
    refined = np.abs(spread_us(found.start_us, truth.start_us)).max()
    assert refined < 1000 < by_landmark
    _, found, truth = calibrated
    assert found.alignment is not None
    for lag in found.alignment.lags:
        assert lag.thresholds.on == pytest.approx(0.2, rel=0.15)
        assert lag.thresholds.off == pytest.approx(0.2, rel=0.15)
    assert set(found.hot.values()) == {len(truth.hot)}


def test_the_ground_truth_is_the_scenes_own(calibrated, config):
    out, found, truth = calibrated
    store = FrameStore.open(out / "frames.zarr")
    # time 0 is where the landmark's events have it, a little before the mean of the region is dark
    zero_us = np.mean([found.start_us[capture] - start for capture, start in truth.start_us.items()])
    assert abs(zero_us) < 1e6 / PICTURE_RATE_HZ
    t_us = store.t_us("one").numpy()
    assert len(t_us) >= 8
    expected = true_dolp(truth, t_us + round(zero_us), config)
    assert float((store.frames("one").dolp - expected).pow(2).mean().sqrt()) < 0.01
    assert float(expected.std()) > 0.05


def test_the_stores_are_benchmarked_and_the_diagnosis_is_drawn(calibrated, config, tmp_path, project_root):
    out, found, _ = calibrated
    test_set = made_set("recordings", out)
    assert (test_set.events.height, test_set.events.width) == (16, 24)
    assert all(count > 100 for count in test_set.events.count("one"))
    whole = load(project_root, [f"paths.data={tmp_path}"])
    methods = ["zeros", "oracle_mean", "cf", "highpass"]
    settings = replace(whole.benchmark, methods=methods, warmup_windows=2, bootstrap_samples=20, panel_scenes=1)
    benchmark = run_benchmark(test_set, context_of(whole, settings.methods, 0.2), settings, None)
    assert {row.method for row in benchmark.rows} == set(methods)
    draw_calibration(found, config, tmp_path / "one.png")
    assert (tmp_path / "one.png").stat().st_size > 10_000
