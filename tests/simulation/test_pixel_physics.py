"""Light on a pixel and the constants of its noise, worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from polarnet.simulation.pixels.light import KNEE, Light, intensity_rows, respond
from polarnet.simulation.pixels.physics import mismatch, physics_of
from polarnet.simulation.presets import SENSORS

PIXELS, KEY = 400, np.uint64(7)
PHYSICS = physics_of(SENSORS["default"])


def rows_of(seen: Light, frame: int, row: int, width: int, rows: int) -> list[list[float]]:
    dn = np.empty(rows * width, np.float32)
    intensity_rows(seen, frame, row, width, dn)
    return dn.reshape(rows, width).tolist()


def test_a_sensor_between_four_scene_pixels_sees_each_by_its_share():
    """A quarter of a pixel down and half a pixel right of row 1, column 0 of a scene of 10 row + column."""
    scene = (10 * np.arange(5.0)[:, None] + np.arange(6.0)).astype(np.float32)[None]
    seen = Light(scene, np.array([0.0, 1.25]), np.array([0.0, 0.5]))
    assert rows_of(seen, 0, 0, 2, 2) == [[0, 1], [10, 11]]
    assert rows_of(seen, 1, 0, 3, 2) == [[13, 14, 15], [23, 24, 25]]
    assert rows_of(seen, 1, 1, 2, 1) == [[23, 24]]


def test_response_is_linear_to_the_knee_and_a_logarithm_right_to_its_bound_above():
    dn = np.geomspace(1e-3, 1e6, 200_001).astype(np.float32)
    response = np.empty_like(dn)
    respond(dn, PHYSICS, response)
    dark = dn <= KNEE
    np.testing.assert_allclose(response[dark], dn[dark] * (math.log(KNEE) / KNEE), rtol=3e-7)
    expected = np.log(dn[~dark].astype(np.float64))
    off = np.abs(response[~dark] - expected) / np.spacing(expected.astype(np.float32))
    assert off.max() < 1.2


def test_thresholds_are_nominal_without_mismatch_and_never_below_a_hundredth():
    nominal = physics_of(SENSORS["default"])._replace(
        threshold_on=0.3, threshold_off=0.2, threshold_sigma_on=0.0, threshold_sigma_off=0.1, threshold_correlation=0.0
    )
    on, off, _ = mismatch(nominal, PIXELS, KEY, 0)
    assert np.unique(on).tolist() == [np.float32(0.3)]
    assert off.min() == np.float32(0.01)
    assert off.mean() == pytest.approx(0.2, abs=0.015)  # three standard errors
    assert off.std() == pytest.approx(0.1, abs=0.012)
    wide, *_ = mismatch(nominal._replace(threshold_on=5.0, threshold_sigma_on=1.0), PIXELS, KEY, 0)
    assert wide.std() == pytest.approx(1, rel=0.12)


@pytest.mark.parametrize("share", [0.1, 0.55])
def test_a_relative_mismatch_is_a_share_of_any_threshold_and_has_no_pixels_near_zero(share):
    changes = {"contrast_threshold_mismatch_on": share, "contrast_threshold_mismatch_off": None}
    for nominal in (0.08, 0.3):
        physics = physics_of(replace(SENSORS["default"], contrast_threshold_on=nominal, **changes))
        on, off, _ = mismatch(physics, 20_000, KEY, 0)
        assert on.mean() == pytest.approx(nominal, rel=0.02)
        assert on.std() / on.mean() == pytest.approx(share, rel=0.05)
        assert (on < 0.15 * nominal).mean() < 1e-3
        assert off.std() == pytest.approx(0.03, rel=0.05)
