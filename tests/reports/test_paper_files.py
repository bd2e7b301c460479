"""The paper's Table 2 and its figures as files, from a run in miniature."""

import cv2
import pytest
import torch

from polarnet.events.stream import Events
from polarnet.reports.artefacts import read_results
from polarnet.reports.legend import legend_of
from polarnet.reports.paper import Moment, figure_11, score_line, write_paper_files
from polarnet.reports.recordings import draw_sequence
from polarnet.storage.frames import Frames


@pytest.fixture
def results(paths):
    simulated = read_results(paths.simulated)
    real = {row: {**scores, "mse": scores["mse"] / 2} for row, scores in simulated.metrics.items()}
    return [simulated._replace(name="simulated"), simulated._replace(name="recordings", metrics=real)]


def test_table_2_has_both_experiments_side_by_side_without_constants(results, tmp_path):
    write_paper_files(tmp_path, results, legend_of(results[0].details["weights"]))
    text = (tmp_path / "table_2.tex").read_text()
    groups, head, *rows = [line.removesuffix(r" \\").split(" & ") for line in text.splitlines() if " & " in line]
    assert groups == ["", r"\multicolumn{3}{c}{Real}", r"\multicolumn{3}{c}{Simulated}"]
    assert head[1:] == [r"MSE $\downarrow$", r"PSNR $\uparrow$", r"SSIM $\uparrow$"] * 2
    assert [row[0] for row in rows] == ["E2V: FireNet", "ours: the paper's network"]
    simulated = results[0].metrics["e2v"]
    psnr, ssim = f"{simulated['psnr']:.2f}", f"{simulated['ssim']:.4f}"
    assert rows[0][1:] == [f"{simulated['mse'] / 2:.4f}", psnr, ssim, f"{simulated['mse']:.4f}", psnr, ssim]
    assert rows[1][1].startswith(r"\textbf{")
    assert "The first 1 windows of each sequence count for no method." in text


def test_figures_9_and_10_are_pictures_and_vector_files(results, tmp_path):
    write_paper_files(tmp_path, results[:1], legend_of({}))
    assert not list(tmp_path.glob("table_2.*"))
    write_paper_files(tmp_path, results, legend_of({}))
    for name in ("figure_9", "figure_10"):
        assert cv2.imread(str(tmp_path / f"{name}.png")).shape[1] > 500
        assert (tmp_path / f"{name}.pdf").read_bytes().startswith(b"%PDF")


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


def test_figure_11_says_when_and_of_how_many_events_and_a_frame_how_far_it_is_off():
    maps = torch.rand(12, 18)
    figure = figure_11([Moment(24_000, 79_191, maps, maps, maps), Moment(35_000, 100_000, maps, maps, maps)])
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[:2] == ["t = 24.0 ms, n = 79,191", "t = 35.0 ms, n = 100,000"]
    assert score_line(torch.full((8, 8), 0.6), torch.full((8, 8), 0.5)) == "0.0100 · 20.00 dB"
