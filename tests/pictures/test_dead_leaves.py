"""Generated pictures: the same from the same seed, and like photographs in what matters."""

import itertools

import cv2
import numpy as np
import pytest

from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.runtime.machine import generator_for


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return [dead_leaves(generator_for(1, f"picture {i}", "test"), 200, 300) for i in range(8)]


def test_the_same_seed_gives_the_same_code_values_and_another_seed_others(pictures):
    assert all(picture.dtype == np.float32 and picture.min() >= 0 and picture.max() <= 1 for picture in pictures)
    again = dead_leaves(generator_for(1, "picture 0", "test"), 200, 300)
    assert np.array_equal(again, pictures[0])
    assert not np.array_equal(pictures[0], pictures[1])


def test_colours_cover_all_hues_and_nearly_all_saturations_and_values(pictures):
    hue, saturation, value = np.concatenate([cv2.cvtColor(p, cv2.COLOR_RGB2HSV).reshape(-1, 3) for p in pictures]).T
    assert np.histogram(hue, bins=12, range=(0, 360))[0].min() > 0.01 * len(hue)
    assert np.percentile(saturation, 10) < 0.2
    assert np.percentile(saturation, 90) > 0.7
    assert np.percentile(value, 10) < 0.2
    assert np.percentile(value, 90) > 0.7


def test_the_power_spectrum_falls_like_that_of_photographs(pictures):
    """Power ~ 1/frequency^2 (Field 1987: between 1.6 and 2.4 for most photographs)."""
    rows, columns = np.fft.fftfreq(200)[:, None], np.fft.fftfreq(200)
    frequency = np.hypot(rows, columns)
    window = np.hanning(200)[:, None] * np.hanning(200)
    power = np.mean(
        [np.abs(np.fft.fft2(window * (p[:, 50:250, 1] - p[:, 50:250, 1].mean()))) ** 2 for p in pictures], axis=0
    )
    bands = np.geomspace(0.02, 0.25, 8)
    mean = [power[(frequency >= low) & (frequency < high)].mean() for low, high in itertools.pairwise(bands)]
    slope = np.polyfit(np.log(np.sqrt(bands[1:] * bands[:-1])), np.log(mean), 1)[0]
    assert -3.0 < slope < -1.6


def test_leaves_are_not_flat(pictures):
    """Gradients and textures: most 3x3 neighbourhoods vary a little, few a lot."""
    for picture in pictures:
        deviation = np.sqrt(np.maximum(cv2.blur(picture**2, (3, 3)) - cv2.blur(picture, (3, 3)) ** 2, 0)).max(axis=2)
        assert (deviation > 1 / 1000).mean() > 0.9
        assert (deviation < 0.1).mean() > 0.6
