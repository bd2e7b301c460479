import math

import numpy as np
import pytest

from polarnet.events.rotation import Rotation, steady_rotation, triggered_rotation


def test_a_steady_polarizer_turns_by_a_quarter_in_a_quarter_of_its_period():
    rotation, back = steady_rotation(2.0, math.radians(20)), steady_rotation(-1.0)
    assert np.degrees(rotation.at(np.array([0, 125_000, 1_125_000]))) == pytest.approx([20, 110, 830])
    assert np.degrees(back.at(np.array([250_000]))) == pytest.approx([-90])
    assert (rotation.half_turn_us, back.rate_hz, back.half_turn_us) == (250_000, -1.0, 500_000)


def test_triggers_follow_an_uneven_rotation_and_the_last_rate_goes_on():
    rotation = triggered_rotation(np.array([1000, 2000, 4000]), math.radians(10))
    assert np.degrees(rotation.at(np.array([1000, 1500, 3000, 6000]))) == pytest.approx([10, 190, 550, 1090])
    assert np.degrees(rotation.since(1000).at(np.array([500]))) == pytest.approx([190])


def test_a_polarizer_at_rest_and_a_single_trigger_are_refused():
    with pytest.raises(ValueError, match="a rate in turns per second other than 0"):
        steady_rotation(0.0)
    with pytest.raises(ValueError, match="at least two trigger times, got 1"):
        triggered_rotation(np.array([5]))
    with pytest.raises(ValueError, match="expected increasing times"):
        Rotation(np.array([1.0, 1.0]), np.array([0.0, 1.0]))
