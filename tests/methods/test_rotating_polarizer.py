import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from polarnet.config.tree import load
from polarnet.events.rotation import steady_rotation
from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import EventWindow
from polarnet.methods.rotating_polarizer import RotatingPolarizerConfig, fit_half_turn, local_variance, open_rotating
from polarnet.simulation.camera import Camera, Grid
from polarnet.simulation.motion import Sine, Trajectory
from polarnet.simulation.rotating import emulate_rotating
from polarnet.simulation.scene import scene_from_polarization
from polarnet.simulation.truth import frames_of

IDEAL = RotatingPolarizerConfig(
    threshold_on=0.2, threshold_off=0.2, cutoff_hz=0.0, level_dn=60.0, ridge=1e-9, silent_dolp=0.1,
    spread_window=3, spread_scale=1.0, variance_floor=1e-4,
)  # fmt: skip
"""For events exactly at the thresholds of the logarithm."""
DOLP = np.array([[0.25, 0.4, 0.6], [0.8, 0.9, 0.5]])
AOLP = np.array([[0.0, 0.3, 1.0], [1.6, 2.4, 3.1]])


def exact_events(dolp, aolp, rotation, stop_us, threshold=0.2, delay_us=0.0):
    """Events at the crossings of ln(1 + DoLP cos 2 (angle - AoLP)), found on a grid of 5 us and between its points."""
    t_us = np.arange(0, stop_us + 5, 5.0)
    rows = []
    for (y, x), m in np.ndenumerate(dolp):
        logs = np.log1p(m * np.cos(2 * (rotation.at(t_us - delay_us) - aolp[y, x])))
        # a level of the staircase is crossed again by the opposite polarity only one threshold further on
        reference = logs[0]
        for k in range(1, len(t_us)):
            while abs(logs[k] - reference) >= threshold:
                p = 1 if logs[k] > reference else -1
                reference += p * threshold
                share = (reference - logs[k - 1]) / (logs[k] - logs[k - 1])
                rows.append((round(t_us[k - 1] + 5 * share), x, y, p))
    columns = np.array(sorted(rows), np.int64).reshape(-1, 4).T
    return Events.from_columns(*columns, *dolp.shape)


def angle_error_deg(found, truth):
    return np.degrees((found.numpy() - truth + math.pi / 2) % math.pi - math.pi / 2)


@pytest.mark.parametrize("rate_hz", [4.0, -4.0])
def test_exact_crossings_of_half_a_turn_give_dolp_and_aolp_back(rate_hz):
    """The first event of a pixel is the reference of the others, whatever the light was before."""
    rotation = steady_rotation(rate_hz, 0.5)
    dolp, aolp, _ = fit_half_turn(exact_events(DOLP, AOLP, rotation, 250_000), rotation, 250_000, IDEAL)
    assert dolp.numpy() == pytest.approx(DOLP, abs=1e-3)
    assert np.abs(angle_error_deg(aolp, AOLP)).max() < 0.05
    assert (aolp >= 0).all()
    assert (aolp < math.pi).all()


@pytest.mark.parametrize("rate_hz", [4.0, -4.0])
def test_the_delay_of_the_photoreceptor_is_taken_off_aolp_and_its_damping_off_dolp(rate_hz):
    """At 117.5 DN the bandwidth is 300 (117.5 + 20) / 275 = 150 Hz: 2 x 4 Hz lag by atan(8 / 150) of a period."""
    rotation = steady_rotation(rate_hz)
    lag = math.atan(8 / 150)
    late_us = lag / (2 * math.pi * 8) * 1e6
    events = exact_events(DOLP, AOLP, rotation, 250_000, delay_us=late_us)
    known = replace(IDEAL, cutoff_hz=300.0, level_dn=117.5)
    dolp, aolp, _ = fit_half_turn(events, rotation, 250_000, known)
    assert np.abs(angle_error_deg(aolp, AOLP)).max() < 0.05
    assert dolp.numpy() == pytest.approx(DOLP * math.hypot(1, 8 / 150), abs=1e-3)
    unaware = fit_half_turn(events, rotation, 250_000, IDEAL)[1]
    assert np.abs(angle_error_deg(unaware, AOLP)) == pytest.approx(np.full((2, 3), math.degrees(lag / 2)), abs=0.05)


def test_a_pixel_with_two_events_counts_as_silent():
    events = Events.from_columns(*np.array([[1000, 2000], [0, 0], [0, 0], [1, -1]]), 2, 3)
    dolp, aolp, log_variance = fit_half_turn(events, steady_rotation(4.0), 125_000, IDEAL)
    assert dolp.numpy() == pytest.approx(np.full((2, 3), 0.1))
    assert aolp.eq(0).all()
    assert log_variance.exp().numpy() == pytest.approx(np.full((2, 3), 1e-4))


def test_only_the_last_half_turn_counts_however_the_events_are_cut_into_windows(make_setup):
    rotation = steady_rotation(4.0)
    before, after = exact_events(DOLP[::-1], AOLP, rotation, 500_000), exact_events(DOLP, AOLP, rotation, 500_000)
    late = slice_time(after, 375_000, 500_000)
    alone = fit_half_turn(late, rotation, 500_000, IDEAL)
    setup = make_setup("rotating_polarizer", config=IDEAL, rotation=rotation)
    recoverer, empty = open_rotating(setup), Events.empty(2, 3)
    cuts = [0, 375_000, 400_000, 470_000, 500_000]
    windows = [
        EventWindow([empty, slice_time(late if start >= 375_000 else before, start, stop), empty, empty], start, stop)
        for start, stop in itertools.pairwise(cuts)
    ]
    _, prediction = recoverer.step(recoverer.start(2, 3), windows)
    for one, expected in zip((prediction.dolp, prediction.aolp, prediction.log_variance), alone, strict=True):
        torch.testing.assert_close(one[-1], expected)


def test_the_local_variance_of_one_bright_pixel_in_nine_and_an_even_square_is_refused():
    frame = torch.zeros(5, 5)
    frame[2, 2] = 1
    assert local_variance(frame, 3)[2, 2].item() == pytest.approx(1 / 9 - 1 / 81)
    assert local_variance(frame, 3)[0, 0].item() == 0.0
    assert local_variance(torch.full((5, 5), 0.7), 3).numpy() == pytest.approx(np.zeros((5, 5)), abs=1e-7)
    with pytest.raises(ValueError, match="spread_window: expected an odd number of pixels, got 4"):
        replace(IDEAL, spread_window=4)


@pytest.mark.parametrize(("speed_px_s", "limit"), [(0.0, 0.008), (40.0, 0.012)])
def test_the_error_on_a_still_and_on_a_moving_scene_is_small_and_is_the_expected_one(project_root, speed_px_s, limit):
    """A smooth random scene; in a moving one, half a turn of 33 ms crosses more than a pixel."""
    config = load(project_root)
    generator = torch.Generator().manual_seed(3)
    coarse = torch.rand(1, 3, 9, 14, generator=generator, dtype=torch.float64)
    s0, dolp, aolp = torch.nn.functional.interpolate(coarse, (40, 80), mode="bilinear")[0]
    scene = scene_from_polarization(0.3 + 0.7 * s0, dolp, 3 * aolp)
    still, path = Sine(0.0, 0.0, 0.0), Sine(1e4, speed_px_s / 1e4, 0.0)  # along a line
    trajectory = Trajectory(20.0, 20.0, (path,), (still,), still, still, speed_px_s)
    camera, rotation = Camera(config.emulate, key=1), config.rotating.rotation
    events = emulate_rotating(config.rotating, camera, scene, trajectory, 200_000, Grid(32, 32))
    _, (truth,), _ = frames_of(scene, trajectory, [200_000], 32, 32)
    estimate, _, log_variance = fit_half_turn(events, rotation, 200_000, config.methods.rotating_polarizer)
    squared = (estimate - truth).square()
    assert squared.mean() < limit
    assert 0.2 < squared.mean() / log_variance.exp().mean() < 4
