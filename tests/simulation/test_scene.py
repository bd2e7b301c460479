"""Hue is the angle, saturation the degree, value the intensity."""

import math

import pytest
import torch

from polarnet.simulation.scene import (
    polarization_from_rgb,
    scene_from_intensities,
    scene_from_polarization,
    scene_from_rgb,
)
from polarnet.stokes import aolp, dolp, intensities_from_stokes


def pixel(*rgb: float) -> torch.Tensor:
    return torch.tensor(rgb).view(3, 1, 1)


@pytest.mark.parametrize(
    ("rgb", "s0", "degree", "angle_deg"),
    [
        ((1.0, 0.0, 0.0), 1.0, 1.0, 0),  # red
        ((0.0, 1.0, 0.0), 1.0, 1.0, 60),  # green
        ((0.0, 0.0, 1.0), 1.0, 1.0, 120),  # blue
        ((1.0, 0.0, 1.0), 1.0, 1.0, 150),
        ((0.5, 0.25, 0.25), 0.5, 0.5, 0),  # dull red
        ((0.7, 0.7, 0.7), 0.7, 0.0, 0),  # grey
        ((0.0, 0.0, 0.0), 0.0, 0.0, 0),
    ],
)
def test_a_colour_has_the_angle_of_its_hue_and_the_degree_of_its_saturation(rgb, s0, degree, angle_deg):
    stokes = scene_from_rgb(pixel(*rgb)).stokes
    assert stokes[0].item() == pytest.approx(s0, abs=1e-6)
    assert dolp(stokes).item() == pytest.approx(degree, abs=1e-6)
    assert aolp(stokes).item() == pytest.approx(math.radians(angle_deg), abs=1e-6)


def test_hue_just_below_red_is_an_angle_just_below_180_degrees():
    angle = math.degrees(polarization_from_rgb(pixel(1.0, 0.0, 0.01))[2].item())
    assert angle == pytest.approx(180 - 0.3, abs=1e-3)  # 0.01 / 6 of the circle of hues below red
    assert 0 <= polarization_from_rgb(pixel(1.0, 0.0, 1e-12))[2].item() < math.pi


def test_measured_intensities_come_back_and_unphysical_ones_are_fully_polarized():
    measured = torch.tensor([0.4, 0.3, 0.1, 0.2]).view(4, 1, 1)  # I0 + I90 = I45 + I135
    torch.testing.assert_close(intensities_from_stokes(scene_from_intensities(measured).stokes), measured)
    stokes = scene_from_intensities(torch.tensor([0.4, 0.4, 0.0, 0.0]).view(4, 1, 1)).stokes
    assert dolp(stokes).item() == pytest.approx(1)  # measured: sqrt(2)
    assert aolp(stokes).item() == pytest.approx(math.pi / 8)
    assert stokes[0].item() == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("s0", "dolp", "aolp", "message"),
    [
        (1.0, 1.0, 90.0, r"aolp: expected radians in \[-3\.14159, 3\.14159\], got values up to 90; .*deg2rad"),
        (1.0, 100.0, 0.0, r"dolp: expected values in \[0, 1\], got values up to 100"),
        (255.0, 1.0, 0.0, r"s0: expected values in \[0, 1\], got values up to 255; divide by 255"),
    ],
)
def test_degrees_percentages_and_bytes_are_no_polarization(s0, dolp, aolp, message):
    with pytest.raises(ValueError, match=message):
        scene_from_polarization(*(torch.full((2, 2), value) for value in (s0, dolp, aolp)))
    with pytest.raises(ValueError, match=r"expected S0 = I0 \+ I90 in \[0, 1\], got values up to 1\.6"):
        scene_from_intensities(torch.full((4, 2, 2), 0.8))
