import cv2
import numpy as np
import pytest
import torch

from polarnet.reports.artefacts import Panel
from polarnet.reports.figures import (
    DARK,
    LIGHT,
    comparison_figure,
    dolp_bar,
    reliability_figure,
    score_distribution,
    score_line,
    training_curves,
    wheel_figure,
)
from polarnet.reports.maps import png

TRUTH = torch.linspace(0, 1, 24 * 36).view(24, 36)
CURVE = [0.3, 0.2, 0.1]
SCORES = {"psnr": {"cf": [7.0, 8.0, 9.0], "ours": [15.0, 16.0, 18.0]}, "mse": {"cf": [0.2, 0.1], "ours": [0.02, 0.03]}}


def scene(*methods):
    dolp = dict.fromkeys(methods, TRUTH / 2)
    return Panel("tree", 0, 33_333, torch.zeros(4, 24, 36), TRUTH, TRUTH, TRUTH, dolp, aolp={})


@pytest.mark.parametrize(
    "draw",
    [
        lambda: training_curves({"mse": CURVE}, CURVE, "validation", LIGHT),
        lambda: score_distribution(SCORES, DARK),
        lambda: dolp_bar(LIGHT),
        lambda: wheel_figure(DARK),
        lambda: reliability_figure({"ours": [(0.01, 0.02, 100), (0.1, 0.1, 300)]}, DARK),
    ],
)
def test_the_same_figure_gives_the_same_bytes_without_date_or_software(draw):
    data = png(draw())
    assert data == png(draw())
    assert not any(chunk in data for chunk in (b"Software", b"tIME", b"Creation"))


def panel(rows):
    return png(comparison_figure(rows, rows[0].dolp))


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


def test_a_panel_of_no_scene_is_an_error():
    with pytest.raises(ValueError, match="at least one panel"):
        comparison_figure([], [])


def test_a_frame_that_is_off_by_a_tenth_everywhere_scores_an_mse_of_a_hundredth_and_20_db():
    assert score_line(torch.full((8, 8), 0.6), torch.full((8, 8), 0.5)) == "0.0100 · 20.00 dB"


def test_figures_for_a_dark_page_have_light_text_and_no_background():
    light, dark = (
        cv2.imdecode(np.frombuffer(png(score_distribution(SCORES, theme)), np.uint8), cv2.IMREAD_UNCHANGED)
        for theme in (LIGHT, DARK)
    )
    assert light[0, 0, 3] == dark[0, 0, 3] == 0
    assert dark[dark[..., 3] == 255][:, :3].mean() > light[light[..., 3] == 255][:, :3].mean()


def test_every_term_of_the_losses_has_a_readable_name_in_the_legend():
    terms = ["total", "mse", "mae", "ssim_loss", "lpips", "stokes", "uncertainty", "intensity_lpips", "aolp_ssim_loss"]
    legend = training_curves({term: [0.1] for term in terms}, CURVE, "", LIGHT).axes[0].get_legend()
    labels = [text.get_text() for text in legend.get_texts()]
    assert labels[-2:] == ["intensity: LPIPS", "AoLP: 1 - SSIM"]
    assert not [label for label in labels if "_" in label]


def test_epochs_count_from_one_on_the_axis():
    line = training_curves({"mse": CURVE}, CURVE, "validation", LIGHT).axes[0].lines[0]
    assert list(line.get_xdata()) == [1, 2, 3]


def test_the_wheel_has_its_angles_beside_it():
    (axes,) = wheel_figure(LIGHT).axes
    places = {text.get_text(): text.get_position() for text in axes.texts}
    assert set(places) == {"0°", "45°", "90°", "135°"}
    assert places["0°"][0] > 1 > places["90°"][0] > places["135°"][0]
    assert places["90°"][1] > 1 > places["0°"][1]
