import re

import pytest

from polarnet.reports.figures import error_chart, reliability_chart, svg, sweep_chart
from polarnet.reports.legend import GENERAL, NETWORKS, glossary, legend_of
from polarnet.reports.tables import COLUMNS, score_table

SCORES = {
    "ours": {"mse": 0.02, "psnr": 17.0, "ssim": 0.4, "lpips": None, "corr": 0.6, "ms_per_window": 19.04},
    "zeros": {"mse": 0.09, "psnr": 11.0, "ssim": 0.1, "lpips": None, "corr": 0.0, "ms_per_window": 0.0},
    "cf": {"mse": 0.3, "psnr": 7.0, "ssim": 0.05, "lpips": None, "corr": 0.1, "ms_per_window": 9.0},
}


def row(table, method):
    return next(row for row in table.rows if row.method == method)


def test_methods_keep_one_order_and_what_rounds_to_zero_has_no_sign():
    assert [r.method for r in score_table(SCORES).rows] == ["zeros", "cf", "ours"]
    table = score_table({"e2vid_official": {"mse": 0.1}, "zeros": {"mse": 0.2}})
    assert [r.label for r in table.rows] == ["zeros", "e2vid_official"]
    assert [COLUMNS["skill"].printed(value) for value in (-0.0001, -0.0006)] == ["0.000", "-0.001"]


def test_the_best_values_are_bold_but_not_speed_and_no_row_of_another_camera():
    table = score_table({"cf": {"psnr": 12.001}, "ours": {"psnr": 12.004}})
    assert [r.cells[0].best for r in table.rows] == [True, True]
    table = score_table(SCORES)
    assert table.headings[-1] == "ms / window ↓"
    assert not any(r.cells[-1].best for r in table.rows)
    table = score_table({"rotating_polarizer": {"mse": 0.01}, "cf": {"mse": 0.3}, "ours": {"mse": 0.02}})
    assert not row(table, "rotating_polarizer").cells[0].best
    assert row(table, "ours").cells[0].best
    assert row(table, "rotating_polarizer").label.endswith("†")
    assert table.notes[0].startswith("† Not ranked: another camera")
    assert score_table({"ours": {"mse": 0.02}}).notes == ()


def test_lpips_names_its_backbone_in_heading_and_caption():
    scores = {method: row | {"lpips": 0.25, "lpips_backbone": "alex"} for method, row in SCORES.items()}
    table = score_table(scores)
    assert "LPIPS (alex) ↓" in table.headings
    assert table.notes == ("LPIPS (alex): version 0.1 on the features of AlexNet.",)
    assert score_table(scores, {"mse": COLUMNS["mse"]}).notes == ()


def weights(**networks):
    return {row: {"file": "best.safetensors", "sha256": "0" * 64, "network": name} for row, name in networks.items()}


@pytest.mark.parametrize(
    ("row", "section", "network", "label"),
    [
        ("ours", "ours", "polarnet", "ours: polarnet's network"),
        ("ours", "ours", "paper", "ours: the paper's network"),
        ("e2v", "e2v", "e2vid", "E2V: E2VID"),
        ("e2v+gain", "e2v", "e2vid", "E2V: E2VID, gains solved"),
        ("paper", "paper", "paper", "the paper's network"),
        ("paper", "paper", "polarnet", "second network: polarnet's network"),
    ],
)
def test_a_row_is_named_and_coloured_after_the_network_behind_it(row, section, network, label):
    legend = legend_of(weights(**{section: network}))
    assert (legend.label(row), legend.colour(row)) == (label, NETWORKS[network].colour)


def test_the_glossary_has_the_rows_of_the_table_and_no_other():
    entries = dict(glossary(["cf", "cf+gain", "ours"], legend_of(weights(ours="paper"))))
    assert list(entries) == ["CF", "ours: the paper's network", "gains solved"]
    assert "gains solved" not in dict(glossary(["cf"], GENERAL))


METRICS = {"oracle_mean": {"mse": 0.03, "mse_ci": [0.02, 0.04]}, "ours": {"mse": 0.02, "mse_ci": [0.01, 0.03]}}


def lines(axes):
    """Points of each line, as pairs."""
    return [list(zip(*line.get_data(), strict=True)) for line in axes.lines]


def test_a_method_or_a_point_of_a_sweep_is_a_dot_on_its_interval():
    (axes,) = error_chart(METRICS, GENERAL).axes
    assert lines(axes)[2:] == [[(0.01, 1), (0.03, 1)], [(0.02, 1)]]
    assert axes.get_yticklabels()[0].get_text() == "oracle mean"
    (axes,) = sweep_chart({"loss.ssim=0.0": (0.5, 0.25)}).axes
    assert lines(axes) == [[(0.25, 0), (0.75, 0)], [(0.5, 0)]]


@pytest.mark.parametrize("figure", [
    lambda: error_chart(METRICS, GENERAL),
    lambda: reliability_chart({"ours": [[0.01, 0.02, 100], [0.1, 0.1, 300]]}, GENERAL),
])  # fmt: skip
def test_a_drawing_takes_its_colours_from_the_page_and_has_the_same_bytes_each_time(figure):
    drawing = svg(figure())
    assert drawing == svg(figure())
    colours = set(re.findall(r"var\(--\w+\)", drawing))
    assert {"var(--text)", "var(--quiet)", "var(--line)"} >= colours > {"var(--quiet)"}
    assert "#00000" not in drawing
    assert "<text" in drawing
    assert all(name.startswith(("p", "m")) for name in re.findall(r' id="(\w+)"', drawing))  # clips and markers
