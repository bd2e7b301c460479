"""Where the overview of the README draws the sensor."""

import numpy as np
import pytest

from polarnet.simulation.motion import random_trajectory
from polarnet.simulation.presets import MOTIONS
from studies.overview import sensor_outline


def test_the_outline_has_the_size_of_the_sensor_and_lies_on_the_picture():
    motion = MOTIONS["default"]
    outline = sensor_outline(random_trajectory(motion, 400, 600, np.random.default_rng(4)), 0.5, 120, 180)
    assert np.hypot(*np.diff(outline, axis=1)) == pytest.approx([179, 119, 179, 119], rel=0.01)
    assert (outline >= 0).all()
    assert (outline.max(axis=1) <= [599, 399]).all()
