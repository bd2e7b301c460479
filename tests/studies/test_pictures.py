"""The pictures of docs, and a camera that is calibrated from its own events."""

import pytest

from polarnet.simulation.presets import SENSORS
from studies import pictures
from studies.camera import FINE, analyzer_errors


@pytest.mark.parametrize("name", pictures.FIGURES)
def test_a_picture_lies_beside_the_page_that_shows_it(project_root, name):
    assert any(f"pictures/{name}.png" in page.read_text() for page in (project_root / "docs").glob("*.md"))
    assert (project_root / "docs" / "pictures" / f"{name}.png").stat().st_size < 300_000


def test_the_pictures_together_stay_small(project_root):
    """Every version of them stays in the history."""
    assert sum(path.stat().st_size for path in (project_root / "docs" / "pictures").iterdir()) < 1_100_000


def test_a_dofp_sensor_is_calibrated_from_its_own_events_to_1_percent():
    assert analyzer_errors(FINE, seed=2).abs().max() < 0.01


@pytest.mark.parametrize("seed", [1, 2])
def test_with_the_noise_mismatch_and_thresholds_of_the_default_sensor_it_is_calibrated_to_1_percent_rms(seed):
    errors = analyzer_errors(SENSORS["default"], seed)
    assert errors.square().mean().sqrt() < 0.01
    assert errors.abs().max() < 0.1
