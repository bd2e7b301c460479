import re

import pytest

from polarnet.reports.artefacts import History, Results
from polarnet.reports.charts import (
    reliability_chart,
    scatter_chart,
    score_chart,
    sets_chart,
    training_chart,
)
from polarnet.reports.figures import svg
from polarnet.reports.legend import GENERAL
from polarnet.reports.tables import COLUMNS

METRICS = {
    "oracle_mean": {"mse": 0.03, "mse_ci": [0.02, 0.04], "psnr": 15.0},
    "ours": {"mse": 0.02, "mse_ci": [0.01, 0.03], "psnr": None},
}
MEANS = {"cf": {"lake": 0.2, "park": 0.1}, "ours": {"lake": 0.02, "park": 0.03}}


def lines(axes):
    """Points of each line, as pairs."""
    return [list(zip(*line.get_data(), strict=True)) for line in axes.lines]


def test_a_score_keeps_its_interval_and_a_method_without_the_score_has_no_row():
    figure = score_chart(METRICS, "mse", COLUMNS["mse"], GENERAL)
    assert lines(figure.axes[0])[2:] == [[(0.01, 1), (0.03, 1)], [(0.02, 1)]]
    psnr = score_chart(METRICS, "psnr", COLUMNS["psnr"], GENERAL)
    assert [tick.get_text() for tick in psnr.axes[0].get_yticklabels()] == ["oracle mean"]


def test_every_scene_is_a_dot_and_the_diagonal_says_where_two_methods_are_equal():
    diagonal, dots = lines(scatter_chart(MEANS, "cf", GENERAL).axes[0])
    assert all(x == y for x, y in diagonal)
    assert set(dots) == {(0.2, 0.02), (0.1, 0.03)}


def test_epochs_of_a_training_count_from_one():
    loss, psnr = training_chart(History("polarnet", {"mse": [0.3, 0.1]}, {"psnr": [9.0, 10.0]}, 1), "DoLP").axes
    assert lines(loss) == [[(1, 0.3), (2, 0.1)]]
    assert lines(psnr) == [[(1, 9.0), (2, 10.0)]]


def test_a_set_is_a_column_of_errors_relative_to_its_best_constant():
    sets = [Results(name, METRICS | {"cf": {"mse": cf}}, {}, []) for name, cf in (("simulated", 0.06), ("mine", None))]
    axes = sets_chart(sets, {"simulated": "Simulated"}, GENERAL).axes[0]
    assert [text.get_text() for text in axes.texts] == ["2.00", "0.67", "0.67"]
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["Simulated", "mine"]


@pytest.mark.parametrize("figure", [
    lambda: score_chart(METRICS, "mse", COLUMNS["mse"], GENERAL),
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
