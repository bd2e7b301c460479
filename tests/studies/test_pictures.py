"""The pictures of docs/simulation.md and docs/physics.md, and the events at constant speed that one of them shows."""

from dataclasses import replace

import numpy as np
import pytest

from polarnet.reports.maps import png
from studies import physics_pictures, simulation_pictures
from studies.physics_pictures import FLAT_WIDTH, events_per_frame, periodic_scene
from studies.simulation_pictures import QUIET, few_colours, light_of_one_pixel, parameters_figure, pixel_events


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


@pytest.mark.parametrize("speed_px_s", [60.0, 97.3])
@pytest.mark.parametrize("render_rate_hz", [300.0, 600.0])
def test_v2e_fires_equally_where_each_frame_holds_as_many_frames_of_light(speed_px_s, render_rate_hz):
    """But for rounding, by which stamps at the end of a frame fall on either side of it."""
    spread, drift = spread_and_drift(
        events_per_frame(replace(QUIET, model="v2e", render_rate_hz=render_rate_hz), speed_px_s)
    )
    assert spread < 0.03
    assert drift < 0.01


def test_v2e_beats_with_the_frames_of_light_otherwise():
    """97.3 frames of light a second are 3 or 4 in each of the 30 frames."""
    spread, _ = spread_and_drift(events_per_frame(replace(QUIET, model="v2e", render_rate_hz=None), 97.3))
    assert 0.05 < spread < 0.15


def test_the_pattern_repeats_after_its_period():
    s0 = periodic_scene(3 * FLAT_WIDTH).stokes[0]
    assert (s0[:, :FLAT_WIDTH] == s0[:, FLAT_WIDTH : 2 * FLAT_WIDTH]).all()


def test_the_events_of_the_pixel_add_up_to_the_change_of_its_log_light():
    """From the first to the last value the log falls by 0.6, less than a threshold short: so do the events in sum."""
    light = light_of_one_pixel(np.array([0.0, 500.0]))
    assert np.isclose(np.log(light[1] / light[0]), -0.6)
    total = int(pixel_events(QUIET).p.sum()) * QUIET.contrast_threshold_on
    assert -0.6 - 1e-6 <= total <= -0.6 + QUIET.contrast_threshold_on


def test_half_the_threshold_gives_about_twice_the_events():
    half = replace(QUIET, contrast_threshold_on=0.1, contrast_threshold_off=0.1)
    assert 1.7 * len(pixel_events(QUIET)) <= len(pixel_events(half)) <= 2.5 * len(pixel_events(QUIET))


def test_the_same_picture_is_drawn_each_time():
    assert few_colours(png(parameters_figure())) == few_colours(png(parameters_figure()))


@pytest.mark.parametrize("name", [*simulation_pictures.FIGURES, *physics_pictures.FIGURES])
def test_a_picture_lies_beside_the_page_that_shows_it(project_root, name):
    assert any(f"pictures/{name}.png" in page.read_text() for page in (project_root / "docs").glob("*.md"))
    assert (project_root / "docs" / "pictures" / f"{name}.png").stat().st_size < 300_000
