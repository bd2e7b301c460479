import math

import numpy as np
import pytest
import torch

from polarnet.stokes import (
    POLARIZER_ANGLES_DEG,
    analyzer,
    aolp,
    dolp,
    intensities_from_stokes,
    intensity_behind_polarizer,
    parse_mosaic,
    stokes_from_intensities,
    stokes_from_polarization,
)


def pixel(*planes: float) -> torch.Tensor:
    return torch.tensor(planes, dtype=torch.float64).view(-1, 1, 1)


def test_eq_1_to_3_on_values_worked_by_hand():
    assert stokes_from_intensities(pixel(0.5, 0.4, 0.1, 0.2)).flatten().tolist() == pytest.approx([0.6, 0.4, 0.2])
    stokes = pixel(10, 3, 4)
    assert dolp(stokes).item() == pytest.approx(0.5)
    assert aolp(stokes).item() == pytest.approx(0.5 * math.atan2(4, 3))
    assert dolp(torch.zeros(3, 1, 1)).item() == 0
    assert dolp(pixel(-1, 1, 0)).item() == 0
    assert dolp(pixel(1, 3, 0)).item() == 3


@pytest.mark.parametrize(
    ("s1", "s2", "degrees"), [(1, 0, 0), (0, 1, 45), (-1, 0, 90), (0, -1, 135), (1, 1, 22.5), (1, -1, 157.5)]
)
def test_aolp_covers_the_whole_half_circle(s1, s2, degrees):
    assert math.degrees(aolp(pixel(2, s1, s2)).item()) == pytest.approx(degrees)
    assert aolp(torch.tensor([1.0, 1.0, -1e-9]).view(3, 1, 1)).item() < math.pi  # where rounding would reach it


@pytest.mark.parametrize("stokes", [(math.nan, 0, 0), (1, math.nan, 0), (0, 0, math.nan), (math.nan,) * 3])
def test_dolp_of_nan_is_nan(stokes):
    assert dolp(pixel(*stokes)).isnan().all()


def test_eq_4_as_printed_equals_the_stokes_form_and_an_analyzer_of_8_to_1_leaks():
    s0, degree, angle = 0.8, 0.3, math.radians(20)
    stokes = stokes_from_polarization(*(torch.full((1, 1), v, dtype=torch.float64) for v in (s0, degree, angle)))
    for degrees in POLARIZER_ANGLES_DEG:
        theta = math.radians(degrees)
        printed = 0.5 * s0 * (1 - degree) + s0 * degree * math.cos(theta - angle) ** 2
        assert intensity_behind_polarizer(stokes, theta).item() == pytest.approx(printed)
    # Transmission 0.8 along and 0.1 across: half the sum of unpolarized light, and half the difference of S1 at 0.
    assert analyzer(0.0, 8.0, 0.8) == pytest.approx((0.45, 0.35, 0.0))
    assert analyzer(math.pi / 4, 8.0, 0.8) == pytest.approx((0.45, 0.0, 0.35))
    assert analyzer(math.pi / 2) == pytest.approx((0.5, -0.5, 0.0))


def test_intensities_and_polarization_come_back_and_numpy_gives_what_torch_gives():
    generator = torch.Generator().manual_seed(0)
    s0, degree, angle = torch.rand(3, 2, 5, 7, dtype=torch.float64, generator=generator) + 0.01
    degree, angle = degree.clamp(max=1), angle * 3
    intensities = intensities_from_stokes(stokes_from_polarization(s0, degree, angle))
    stokes = stokes_from_intensities(intensities)
    torch.testing.assert_close(stokes[:, 0], s0)
    torch.testing.assert_close(dolp(stokes), degree)
    torch.testing.assert_close(aolp(stokes), angle)
    torch.testing.assert_close(intensities[:, 0] + intensities[:, 2], intensities[:, 1] + intensities[:, 3])
    light = np.random.default_rng(0).random((2, 4, 5, 6))
    stokes = stokes_from_intensities(light)
    assert torch.equal(stokes, stokes_from_intensities(torch.from_numpy(light)))
    assert torch.equal(dolp(stokes.numpy()), dolp(stokes))


@pytest.mark.parametrize(
    ("light", "message"),
    [
        (np.zeros((4, 2, 2), np.uint8), "intensities: expected floating-point numbers, got torch.uint8; divide by 255"),
        (torch.zeros(2, 2, 4), r"expected \(\.\.\., 4, height, width\), got \(2, 2, 4\); use permute\(2, 0, 1\)"),
        (torch.zeros(4), r"got \(4,\)"),
    ],
)
def test_intensities_whose_differences_would_be_wrong_are_refused(unchecked_annotations, light, message):
    with pytest.raises(ValueError, match=message):
        stokes_from_intensities(light)
    with pytest.raises(ValueError, match=r"one shape, got s0 \(2, 3\), dolp \(1, 3\), aolp \(2, 3\)"):
        stokes_from_polarization(torch.ones(2, 3), torch.ones(1, 3), torch.ones(2, 3))


def test_a_mosaic_is_read_row_by_row_and_holds_every_angle_once():
    assert parse_mosaic(" 90 45 / 135 0 ") == ((90, 45), (135, 0))
    for text in ("90 45 / 135 135", "90 45 135 0", "0 45 / 90"):
        with pytest.raises(ValueError, match="expected the angles 0, 45, 90 and 135"):
            parse_mosaic(text)
