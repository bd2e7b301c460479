from studies.camera import analyzer_error_max


def test_a_dofp_sensor_is_calibrated_from_its_own_events_to_1_percent():
    assert analyzer_error_max(seed=2) < 0.01
