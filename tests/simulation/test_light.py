"""The response of pixels to light."""

import math

import numpy as np

from polarnet.simulation.pixels.light import KNEE, linlog


def test_response_is_linear_to_the_knee_and_a_logarithm_right_to_its_bound_above():
    dn = np.geomspace(1e-3, 1e6, 200_001).astype(np.float32)
    response = np.empty_like(dn)
    linlog(dn, response)
    dark = dn <= KNEE
    np.testing.assert_allclose(response[dark], dn[dark] * (math.log(KNEE) / KNEE), rtol=3e-7)
    expected = np.log(dn[~dark].astype(np.float64))
    off = np.abs(response[~dark] - expected) / np.spacing(expected.astype(np.float32))
    assert off.max() < 1.2
