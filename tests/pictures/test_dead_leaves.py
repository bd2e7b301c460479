"""Generated pictures: the same from the same seed, and like photographs in what matters."""

import cv2
import numpy as np
import pytest

from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.runtime.machine import generator_for


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return [dead_leaves(generator_for(1, f"picture {i}", "test"), 200, 300) for i in range(8)]


def test_the_same_seed_gives_the_same_picture_and_pictures_cover_hues_saturations_and_values(pictures):
    assert all(picture.dtype == np.float32 and picture.min() >= 0 and picture.max() <= 1 for picture in pictures)
    again = dead_leaves(generator_for(1, "picture 0", "test"), 200, 300)
    assert np.array_equal(again, pictures[0])
    assert not np.array_equal(pictures[0], pictures[1])
    hue, saturation, value = np.concatenate([cv2.cvtColor(p, cv2.COLOR_RGB2HSV).reshape(-1, 3) for p in pictures]).T
    assert np.histogram(hue, bins=12, range=(0, 360))[0].min() > 0.01 * len(hue)
    assert np.percentile(saturation, 10) < 0.2
    assert np.percentile(saturation, 90) > 0.7
    assert np.percentile(value, 10) < 0.2
    assert np.percentile(value, 90) > 0.7
