"""Light on a pixel and the constants of its noise, worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.light import (
    KNEE,
    Light,
    intensity_rows,
    respond,
    respond_8bit,
    respond_as_v2e,
    table_of_response,
)
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


def test_scene_pixels_are_mixed_by_area_even_where_they_do_not_lie_on_a_plane():
    """(1 - 1/4)(1 - 1/2) 8 + (1 - 1/4) 1/2 16 + 1/4 (1 - 1/2) 32 + 1/4 1/2 80 = 3 + 6 + 4 + 10."""
    scene = np.array([[[8, 16], [32, 80]]], np.float32)
    assert rows_of(Light(scene, np.array([0.25]), np.array([0.5])), 0, 0, 1, 1) == [[23]]


def test_response_is_linear_to_the_knee_and_a_logarithm_right_to_its_bound_above():
    dn = np.geomspace(1e-3, 1e6, 200_001).astype(np.float32)
    response = np.empty_like(dn)
    respond(dn, PHYSICS, response)
    dark = dn <= KNEE
    np.testing.assert_allclose(response[dark], dn[dark] * (math.log(KNEE) / KNEE), rtol=3e-7)
    expected = np.log(dn[~dark].astype(np.float64))
    off = np.abs(response[~dark] - expected) / np.spacing(expected.astype(np.float32))
    assert off.max() < 1.2


def test_8_bit_light_is_rounded_before_the_response():
    dn, response = np.array([0.4, 10.5, 20.0, 99.7, 255.0], np.float32), np.empty(5, np.float32)
    respond_8bit(dn, table_of_response(PHYSICS), response)
    assert dn.tolist() == [0, 11, 20, 100, 255]
    expected = [0, 11 * math.log(20) / 20, math.log(20), math.log(100), math.log(255)]
    assert response.tolist() == pytest.approx(expected, abs=1e-6)


def test_the_response_of_v2e_is_rounded_to_eight_decimals():
    dn, response = np.linspace(0.01, 255, 5000, dtype=np.float32), np.empty(5000, np.float32)
    respond_as_v2e(dn, PHYSICS, response)
    exact = np.where(dn <= 20, np.float64(dn) * (math.log(20) / 20), np.log(np.float64(dn)))
    assert response.tolist() == exact.round(8).astype(np.float32).tolist()


@pytest.mark.parametrize("dark_dn", [0.0, 5.0, 20.0])
def test_with_dark_dn_the_response_is_a_logarithm_over_six_decades(dark_dn):
    """In float32 and in v2e's float64; no dark current counts as 0.0001 DN."""
    physics = physics_of(replace(SENSORS["default"], dark_dn=dark_dn))
    dn = np.concatenate([[0], np.geomspace(255e-6, 255, 10_000)]).astype(np.float32)
    fast, slow = np.empty((2, dn.size), np.float32)
    respond(dn, physics, fast)
    respond_as_v2e(dn, physics, slow)
    expected = np.log(dn.astype(np.float64) + max(dark_dn, 1e-4))
    assert fast == pytest.approx(expected, abs=2e-6)
    assert slow == pytest.approx(expected, abs=1e-6)


def test_the_slope_of_the_response_jumps_by_the_logarithm_of_the_knee():
    """Three times at v2e's 20 DN, and not at all at e."""
    for knee_dn, jump in ((20.0, math.log(20)), (2.72, 1.0)):
        physics, response = physics_of(replace(SENSORS["default"], knee_dn=knee_dn)), np.empty(3, np.float32)
        respond_as_v2e(np.array([0.99, 1, 1.01], np.float32) * np.float32(knee_dn), physics, response)
        below, above = np.diff(response.astype(np.float64))
        assert below / above == pytest.approx(jump, rel=0.02)


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


def test_leak_rates_spread_by_a_tenth_of_a_decade_around_the_nominal_one():
    physics = physics_of(SENSORS["default"])._replace(noise_rate_cov_decades=0.1)
    normal = randomness.normal_map(KEY, randomness.NOISE_RATE, 0, PIXELS)
    assert normal.mean() == pytest.approx(0, abs=0.15)
    assert normal.std() == pytest.approx(1, rel=0.12)
    for decades in (0.1, 1.0):
        *_, factors = mismatch(physics._replace(noise_rate_cov_decades=decades), PIXELS, KEY, 0)
        assert factors == pytest.approx(10 ** (decades * normal), rel=1e-5)
    assert mismatch(physics._replace(noise_rate_cov_decades=0.0), 3, KEY, 0)[2].tolist() == [1, 1, 1]
