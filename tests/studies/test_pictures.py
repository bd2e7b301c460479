"""The pictures of docs/simulation.md and docs/physics.md, and the events at constant speed that one of them shows."""

from dataclasses import replace

import numpy as np
import pytest

from studies import physics_pictures, simulation_pictures
from studies.physics_pictures import events_per_frame
from studies.simulation_pictures import QUIET, light_of_one_pixel, pixel_events


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


def test_the_events_of_the_pixel_add_up_to_the_change_of_its_log_light():
    """From the first to the last value the log falls by 0.6, less than a threshold short: so do the events in sum."""
    light = light_of_one_pixel(np.array([0.0, 500.0]))
    assert np.isclose(np.log(light[1] / light[0]), -0.6)
    total = int(pixel_events(QUIET).p.sum()) * QUIET.contrast_threshold_on
    assert -0.6 - 1e-6 <= total <= -0.6 + QUIET.contrast_threshold_on


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


@pytest.mark.parametrize("name", [*simulation_pictures.FIGURES, *physics_pictures.FIGURES])
def test_a_picture_lies_beside_the_page_that_shows_it(project_root, name):
    assert any(f"pictures/{name}.png" in page.read_text() for page in (project_root / "docs").glob("*.md"))
    assert (project_root / "docs" / "pictures" / f"{name}.png").stat().st_size < 300_000
