import cv2
import numpy as np
import torch

from polarnet.reports.figures import comparison_figure, score_line
from polarnet.reports.maps import png
from polarnet.storage.panels import Panel, Shown, fraction_bytes

TRUTH = torch.linspace(0, 1, 24 * 36).view(24, 36)


def scene(*methods):
    film, times = fraction_bytes(TRUTH)[None], torch.tensor([33_333])
    truth, half = (Shown(dolp, None, film, None) for dolp in (TRUTH, TRUTH / 2))
    half = dict.fromkeys(methods, half)
    return Panel("tree", 0, 33_333, torch.zeros(4, 24, 36), TRUTH, times, film, film, truth, half)


def panel(rows):
    return png(comparison_figure(rows, rows[0].predictions))


def test_a_comparison_panel_gives_the_same_bytes():
    assert panel([scene("cf", "ours")]) == panel([scene("cf", "ours")])


def test_a_comparison_panel_grows_by_a_row_a_scene_and_a_column_a_method():
    def size(rows):
        return cv2.imdecode(np.frombuffer(panel(rows), np.uint8), cv2.IMREAD_COLOR).shape[:2]

    height, width = size([scene("ours")])
    assert size([scene("ours")] * 2)[0] > 1.5 * height
    assert size([scene("cf", "ours")])[1] > 1.2 * width


def test_constants_have_no_place_in_a_comparison_panel():
    assert panel([scene("ours")]) == panel([scene("zeros", "oracle_mean", "ours")])


def test_a_frame_that_is_off_by_a_tenth_everywhere_scores_an_mse_of_a_hundredth_and_20_db():
    assert score_line(torch.full((8, 8), 0.6), torch.full((8, 8), 0.5)) == "0.0100 · 20.00 dB"
