import math

import cv2
import numpy as np
import pytest
import torch

from polarnet.reports.maps import (
    AOLP_TABLE,
    angle_image,
    dolp_image,
    encode_png,
    event_full_scale,
    event_image,
    intensity_image,
    polarization_hsv,
)

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def pixel(value):
    return torch.full((1, 1), float(value))


@pytest.mark.parametrize(("aolp_deg", "colour"), [(0, RED), (60, GREEN), (120, BLUE), (180, RED)])
def test_fully_polarized_light_shows_its_angle_as_hue(aolp_deg, colour):
    assert tuple(polarization_hsv(pixel(1), pixel(1), pixel(math.radians(aolp_deg)))[0, 0]) == colour


def test_a_page_that_blends_the_hues_with_white_has_the_colours_of_the_videos():
    steps, dolp = torch.arange(256)[None], torch.linspace(0, 1, 11)[:, None].expand(11, 256)
    blended = 255 - dolp[..., None].numpy() * (255.0 - AOLP_TABLE)  # as player.js does
    assert abs(angle_image(dolp, math.pi * (steps / 256).expand(11, 256)) - blended).max() <= 1


def test_the_papers_map_with_dolp_as_value_and_light_without_polarization():
    assert tuple(polarization_hsv(pixel(1), pixel(0), pixel(1.0))[0, 0]) == (255, 255, 255)
    assert tuple(polarization_hsv(pixel(0.2), pixel(0), pixel(1.0))[0, 0]) == (51, 51, 51)
    assert tuple(polarization_hsv(pixel(1), pixel(1), pixel(math.radians(60)))[0, 0]) == GREEN
    assert tuple(polarization_hsv(pixel(0.2), pixel(1), pixel(0))[0, 0]) == (51, 0, 0)


def test_on_is_red_off_is_blue_and_full_scale_ignores_silent_and_hot_pixels():
    on, off, none = event_image(torch.tensor([[3.0, -3.0, 0.0]]), full_scale=3.0)[0].tolist()
    assert on[0] > max(on[1:])
    assert off[2] > max(off[:2])
    assert none == [255, 255, 255]
    events = torch.zeros(1, 1, 10_000)
    events[0, 0, :1000] = -2.0
    events[0, 0, 5000] = 900.0
    assert event_full_scale(events) == 2.0
    assert event_full_scale(torch.zeros(4, 3, 3)) == 1.0


def test_dolp_grows_lighter_values_are_clamped_and_a_picture_encodes_to_the_same_bytes():
    """Rec. 709 luminance of the colours rises: the map also reads in grey."""
    picture = dolp_image(torch.linspace(0, 1, 64)[None]).astype(float)
    assert (np.diff(picture[0] @ [0.2126, 0.7152, 0.0722]) > 0).all()
    values, clamped = torch.tensor([[-0.5, 1.5]]), torch.tensor([[0.0, 1.0]])
    assert (dolp_image(values) == dolp_image(clamped)).all()
    assert intensity_image(values)[0].tolist() == [[0, 0, 0], [255, 255, 255]]
    picture = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    data = encode_png(picture)
    assert data == encode_png(picture.copy())
    assert not any(chunk in data for chunk in (b"tEXt", b"iTXt", b"tIME"))
    assert (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] == picture).all()
