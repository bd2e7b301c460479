"""A sensor that moves at constant speed over an even texture fires equally in each frame."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from polarnet.simulation import MOTIONS, SENSORS, Camera, Trajectory, emulate_motion, scene_from_polarization
from polarnet.simulation.motion import Sine, frame_times_us

QUIET = replace(SENSORS["clean"], contrast_threshold_sigma_on=0.0, contrast_threshold_sigma_off=0.0)
FLAT_HEIGHT, FLAT_WIDTH = 40, 200
SETTLING_FRAMES = 6  # until each pixel has fired, and its memory is that of an endless motion
STILL = Sine(0.0, 0.0, 0.0)


def periodic_scene(columns):
    """Unpolarized light whose pattern repeats after `FLAT_WIDTH` columns: the sensor always sees all of it."""
    generator = np.random.default_rng(0)
    pattern = generator.standard_normal((FLAT_HEIGHT + 2, FLAT_WIDTH))
    smooth = np.exp(-((np.arange(FLAT_WIDTH // 2 + 1) / 25) ** 2))
    pattern = np.fft.irfft(np.fft.rfft(pattern, axis=1) * smooth, FLAT_WIDTH, axis=1)
    s0 = (0.4 * np.exp(0.5 * pattern / pattern.std())).clip(0, 1)
    plane = torch.from_numpy(np.tile(s0, (1, columns // FLAT_WIDTH + 1))).float()
    return scene_from_polarization(plane, torch.zeros_like(plane), torch.zeros_like(plane))


def events_per_frame(config, speed_px_s, duration_s=2.0):
    """Events of successive frames of a sensor that drifts at constant speed, after the first `SETTLING_FRAMES`.

    It moves by less than the pattern's period, after which all pixels would cross their first level at once.
    """
    assert speed_px_s * duration_s < FLAT_WIDTH
    far = 1e6  # amplitude of a sine whose start is a straight line
    line = Sine(far, speed_px_s / far, 0.0)
    path = Trajectory(FLAT_WIDTH / 2 + 1, (FLAT_HEIGHT + 1) / 2, (line,), (STILL,), STILL, STILL, speed_px_s)
    edges_us = frame_times_us(replace(MOTIONS["default"], duration_s=duration_s))
    scene = periodic_scene(int(speed_px_s * duration_s) + FLAT_WIDTH + 8)
    events = emulate_motion(Camera(config, key=1), scene, path, int(edges_us[-1]), (FLAT_HEIGHT, FLAT_WIDTH))[0]
    return np.diff(np.searchsorted(events.t.numpy(), edges_us))[SETTLING_FRAMES:]


def spread_and_drift(counts: np.ndarray) -> tuple[float, float]:
    """Relative RMS deviation from the mean, and the slope over all frames as a share of the mean."""
    slope = np.polyfit(np.arange(len(counts)), counts, 1)[0]
    return counts.std() / counts.mean(), abs(slope) * len(counts) / counts.mean()


@pytest.mark.parametrize("speed_px_s", [60.0, 97.3])
@pytest.mark.parametrize("render_rate_hz", [None, 200.0, 300.0, 1000.0])
def test_exact_fires_equally_in_each_frame_of_constant_motion_at_any_render_rate(speed_px_s, render_rate_hz):
    counts = events_per_frame(replace(QUIET, render_rate_hz=render_rate_hz), speed_px_s)
    spread, drift = spread_and_drift(counts)
    assert counts.mean() > 5_000
    assert spread < 0.01
    assert drift < 0.01


@pytest.mark.parametrize(
    ("render_rate_hz", "speed_px_s", "lowest", "highest"),
    [(300.0, 60.0, 0, 0.03), (600.0, 97.3, 0, 0.03), (None, 97.3, 0.05, 0.15)],
)
def test_v2e_fires_equally_only_where_each_frame_holds_as_many_frames_of_light(
    render_rate_hz, speed_px_s, lowest, highest
):
    """Stamps at the end of a frame fall on either side of it; 97.3 frames of light a second are 3 or 4 in each."""
    config = replace(QUIET, model="v2e", render_rate_hz=render_rate_hz)
    spread, _ = spread_and_drift(events_per_frame(config, speed_px_s))
    assert lowest < spread < highest
