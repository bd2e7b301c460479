"""The paper's figures 8, 9 and 10 as files."""

import cv2
import torch

from polarnet.events.stream import Events
from polarnet.reports.figures import comparison_figure, score_line
from polarnet.reports.maps import png
from polarnet.reports.recordings import draw_sequence
from polarnet.storage.frames import Frames
from polarnet.storage.panels import Panel, Shown, fraction_bytes

TRUTH = torch.linspace(0, 1, 24 * 36).view(24, 36)


def test_figure_8_has_a_column_for_each_time_and_a_row_for_each_kind(tmp_path):
    time = torch.arange(4) * 10_000
    zero = torch.zeros(2, dtype=torch.int16)
    events = Events(torch.tensor([5_000, 15_000]), zero, zero, torch.ones(2, dtype=torch.int8), 12, 18)
    sizes = []
    for frames in (2, 4):
        dolp = torch.rand(frames, 12, 18)
        draw_sequence([events] * 4, Frames(time[:frames], torch.rand(frames, 4, 12, 18), dolp, dolp), tmp_path / "a")
        sizes.append(cv2.imread(str(tmp_path / "a.png")).shape)
        assert {path.suffix for path in tmp_path.iterdir()} == {".png", ".pdf"}
    (height, one, _), (same, three, _) = sizes  # windows between 2 and 4 frames
    assert height == same
    assert three > 1.8 * one
    assert height > 9 * one / 5


def scene(*methods):
    film, times = fraction_bytes(TRUTH)[None], torch.tensor([33_333])
    truth, half = (Shown(dolp, None, film, None) for dolp in (TRUTH, TRUTH / 2))
    return Panel(
        "tree", 0, 33_333, torch.zeros(4, 24, 36), TRUTH, times, film, film, truth, dict.fromkeys(methods, half)
    )


def test_a_comparison_grows_by_a_row_a_scene_and_a_column_a_method_without_constants():
    def figure(*rows):
        return comparison_figure(rows)

    one = figure(scene("ours"))
    assert figure(*[scene("ours")] * 2).get_figheight() > 1.5 * one.get_figheight()
    assert figure(scene("cf", "ours")).get_figwidth() > 1.2 * one.get_figwidth()
    assert png(one) == png(figure(scene("zeros", "oracle_mean", "ours")))


def test_a_frame_that_is_off_by_a_tenth_everywhere_scores_an_mse_of_a_hundredth_and_20_db():
    assert score_line(torch.full((8, 8), 0.6), torch.full((8, 8), 0.5)) == "0.0100 · 20.00 dB"
