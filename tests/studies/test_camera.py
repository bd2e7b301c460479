import pytest

from polarnet.simulation.presets import SENSORS
from studies.camera import FINE, analyzer_errors


def test_a_dofp_sensor_is_calibrated_from_its_own_events_to_1_percent():
    assert analyzer_errors(FINE, seed=2).abs().max() < 0.01


@pytest.mark.parametrize("seed", [1, 2])
def test_with_the_noise_mismatch_and_thresholds_of_the_default_sensor_it_is_calibrated_to_1_percent_rms(seed):
    errors = analyzer_errors(SENSORS["default"], seed)
    assert errors.square().mean().sqrt() < 0.01
    assert errors.abs().max() < 0.1
