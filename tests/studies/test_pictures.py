"""The pictures of docs, and a camera that is calibrated from its own events."""

import pytest

from polarnet.simulation.presets import SENSORS
from studies import pictures
from studies.camera import FINE, analyzer_errors


@pytest.mark.parametrize("name", pictures.FIGURES)
def test_a_picture_lies_beside_the_page_that_shows_it(project_root, name):
    assert any(f"pictures/{name}" in page.read_text() for page in (project_root / "docs").glob("*.md"))
    assert (project_root / "docs" / "pictures" / name).stat().st_size < 300_000


def test_the_pictures_together_stay_small(project_root):
    """Every version of them stays in the history."""
    assert sum(path.stat().st_size for path in (project_root / "docs" / "pictures").iterdir()) < 1_100_000


@pytest.mark.thorough
@pytest.mark.parametrize(("sensor", "largest", "rms"), [(FINE, 0.01, 0.01), (SENSORS["default"], 0.1, 0.01)])
def test_a_dofp_sensor_is_calibrated_from_its_own_events_to_1_percent(sensor, largest, rms):
    """For the default sensor, with its noise, mismatch and thresholds, in the mean over pixels."""
    errors = analyzer_errors(sensor, seed=2)
    assert errors.abs().max() < largest
    assert errors.square().mean().sqrt() < rms
