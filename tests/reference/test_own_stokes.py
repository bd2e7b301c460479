"""A scene's own Stokes values come back through pixels that follow the light and a filter that sums their events.

Before the scene appears every polarizer passes the same light, REST. A pixel then fires one event per threshold C of
log intensity, and the complementary filter without forgetting sums C per event. So the sum differs from ln(I / REST)
by less than C, and every recovered intensity is within a factor exp(C) of its own.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from polarnet.methods.complementary_filter import FilterConfig, at_rest, image_of, integrate
from polarnet.simulation.emulator import emulate
from polarnet.simulation.presets import SENSORS
from polarnet.stokes import aolp, dolp, intensities_from_stokes, stokes_from_intensities, stokes_from_polarization

C = 0.02  # contrast threshold and filter step, natural-log intensity
REST = 0.25  # of full scale, behind each polarizer
S0 = 0.8
HEIGHT, WIDTH = 12, 16
APPEARS_US = 100_000
FILTER = FilterConfig(
    cutoff_hz=0.0, decay_per_event=0.0, contrast_on=C, contrast_off=-C, intensity_range=[-1.0, 1 / REST - 1]
)
"""Shows exp(L) REST, which is the intensity itself: L is 0 at REST."""


@pytest.fixture(scope="module")
def stokes() -> torch.Tensor:
    """DoLP rises from left to right to 0.75, AoLP from top to bottom to pi."""
    across = torch.linspace(0, 0.75, WIDTH).expand(HEIGHT, WIDTH)
    down = torch.linspace(0, math.pi * (1 - 1 / HEIGHT), HEIGHT)[:, None].expand(HEIGHT, WIDTH)
    return stokes_from_polarization(torch.full((HEIGHT, WIDTH), S0), across, down)


@pytest.fixture(scope="module", params=["exact", "v2e"])
def recovered(request, stokes) -> torch.Tensor:
    """Stokes parameters from the events of a clean sensor, in which the scene appears within a tenth of a second."""
    config = dataclasses.replace(
        SENSORS["clean"],
        model=request.param,
        contrast_threshold_on=C,
        contrast_threshold_off=C,
        contrast_threshold_sigma_on=0.0,
        contrast_threshold_sigma_off=0.0,
    )
    intensities = intensities_from_stokes(stokes)
    share = torch.linspace(0, 1, 31)[:, None, None, None]
    frames = 255 * (REST + share * (intensities - REST))
    events, _ = emulate(frames, torch.linspace(0, APPEARS_US, 31, dtype=torch.float64), config, key=1)
    state = integrate(at_rest(4, HEIGHT, WIDTH), events, APPEARS_US, FILTER)
    reconstruction = image_of(state, FILTER, np.expm1)
    assert ((reconstruction / intensities).log().abs() < 1.01 * C).all()
    return stokes_from_intensities(reconstruction)


def test_dolp_is_the_scenes_own_within_three_thresholds(stokes, recovered):
    """S0, S1 and S2 are each off by at most C S0, so DoLP is off by at most (sqrt(2) + DoLP) C."""
    error = dolp(recovered) - dolp(stokes)
    assert error.abs().max() < 3 * C
    assert error.abs().mean() < C


def test_aolp_is_the_scenes_own_within_the_threshold_over_dolp(stokes, recovered):
    """(S1, S2) is off by at most sqrt(2) C S0 and DoLP S0 long; AoLP is half its angle."""
    polarized = dolp(stokes) > 0.2
    turned = torch.remainder(aolp(recovered) - aolp(stokes) + math.pi / 2, math.pi) - math.pi / 2
    assert (turned.abs() * dolp(stokes) < C)[polarized].all()
