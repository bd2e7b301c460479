"""The pictures of docs/simulation.md and docs/physics.md, and the events that one of them shows."""

import numpy as np
import pytest

from studies import physics_pictures, simulation_pictures
from studies.simulation_pictures import QUIET, light_of_one_pixel, pixel_events


def test_the_events_of_the_pixel_add_up_to_the_change_of_its_log_light():
    """From the first to the last value the log falls by 0.6, less than a threshold short: so do the events in sum."""
    light = light_of_one_pixel(np.array([0.0, 500.0]))
    assert np.isclose(np.log(light[1] / light[0]), -0.6)
    total = int(pixel_events(QUIET).p.sum()) * QUIET.contrast_threshold_on
    assert -0.6 - 1e-6 <= total <= -0.6 + QUIET.contrast_threshold_on


@pytest.mark.parametrize("name", [*simulation_pictures.FIGURES, *physics_pictures.FIGURES])
def test_a_picture_lies_beside_the_page_that_shows_it(project_root, name):
    assert any(f"pictures/{name}.png" in page.read_text() for page in (project_root / "docs").glob("*.md"))
    assert (project_root / "docs" / "pictures" / f"{name}.png").stat().st_size < 300_000


def test_the_pictures_together_stay_small(project_root):
    """Every version of them stays in the history."""
    assert sum(path.stat().st_size for path in (project_root / "docs" / "pictures").iterdir()) < 1_100_000
