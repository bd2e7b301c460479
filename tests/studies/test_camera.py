import pytest

from studies.camera import DEFECTS, analyzer_error_max


@pytest.mark.parametrize("defect", DEFECTS)
def test_each_defect_of_the_camera_is_mended(defect):
    assert DEFECTS[defect]()


def test_a_dofp_sensor_is_calibrated_from_its_own_events_to_1_percent():
    assert analyzer_error_max(seed=2) < 0.01
