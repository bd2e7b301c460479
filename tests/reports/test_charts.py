import re

import pytest

from polarnet.reports.artefacts import BudgetPoint, History, Results
from polarnet.reports.charts import (
    budget_chart,
    loss_chart,
    psnr_chart,
    reliability_chart,
    scatter_chart,
    score_chart,
    sets_chart,
    spread_chart,
    term_label,
)
from polarnet.reports.html import svg
from polarnet.reports.legend import GENERAL
from polarnet.reports.tables import COLUMNS

METRICS = {
    "oracle_mean": {"mse": 0.03, "mse_ci": [0.02, 0.04], "psnr": 15.0},
    "ours": {"mse": 0.02, "mse_ci": [0.01, 0.03], "psnr": None},
}
MEANS = {"cf": {"lake": 0.2, "park": 0.1}, "ours": {"lake": 0.02, "park": 0.03}}
HISTORY = History("polarnet", {"mse": [0.3, 0.1]}, {"psnr": [9.0, 10.0]}, 1)
POINTS = [BudgetPoint("ours", 0.0, 0.3, 1), BudgetPoint("ours", 2.0, 0.1, 4), BudgetPoint("cf", 2.0, 0.2, 4)]


def lines(figure):
    """Points of each line, as pairs."""
    return [list(zip(*line.get_data(), strict=True)) for line in figure.axes[0].lines]


def test_a_score_keeps_its_interval_and_a_method_without_the_score_has_no_row():
    figure = score_chart(METRICS, "mse", COLUMNS["mse"], GENERAL)
    assert lines(figure)[2:] == [[(0.01, 1), (0.03, 1)], [(0.02, 1)]]
    psnr = score_chart(METRICS, "psnr", COLUMNS["psnr"], GENERAL)
    assert [tick.get_text() for tick in psnr.axes[0].get_yticklabels()] == ["oracle mean"]


def test_every_scene_is_a_dot_of_its_method_and_the_diagonal_says_where_two_are_equal():
    diagonal, dots = lines(scatter_chart(MEANS, "cf", GENERAL))
    assert all(x == y for x, y in diagonal)
    assert set(dots) == {(0.2, 0.02), (0.1, 0.03)}
    assert [len(points) for points in lines(spread_chart(MEANS, GENERAL))] == [2, 1, 2, 1]  # scenes, median


def test_a_method_keeps_its_colour_in_the_event_budget_and_zero_events_have_no_place_on_its_axis():
    own = {line.get_label(): line for line in budget_chart(POINTS, GENERAL).axes[0].lines}[GENERAL.label("ours")]
    assert own.get_color() == GENERAL.colour("ours")
    assert list(own.get_xdata()) == [2.0]


def test_epochs_count_from_one():
    assert lines(loss_chart(HISTORY)) == [[(1, 0.3), (2, 0.1)]]
    assert lines(psnr_chart(HISTORY, "DoLP")) == [[(1, 9.0), (2, 10.0)]]


def test_a_set_is_a_column_of_errors_relative_to_its_best_constant():
    sets = [Results(name, METRICS | {"cf": {"mse": cf}}, {}, []) for name, cf in (("simulated", 0.06), ("mine", None))]
    figure = sets_chart(sets, {"simulated": "Simulated"}, GENERAL)
    assert [text.get_text() for text in figure.axes[0].texts] == ["2.00", "0.67", "0.67"]
    assert [tick.get_text() for tick in figure.axes[0].get_xticklabels()] == ["Simulated", "mine"]


@pytest.mark.parametrize("figure", [
    lambda: score_chart(METRICS, "mse", COLUMNS["mse"], GENERAL),
    lambda: reliability_chart({"ours": [[0.01, 0.02, 100], [0.1, 0.1, 300]]}, GENERAL),
])  # fmt: skip
def test_a_drawing_takes_its_colours_from_the_page_and_has_the_same_bytes_each_time(figure):
    drawing = svg(figure())
    assert drawing == svg(figure())
    assert (
        {"var(--text)", "var(--quiet)", "var(--line)"} >= set(re.findall(r"var\(--\w+\)", drawing)) > {"var(--quiet)"}
    )
    assert "#00000" not in drawing
    assert "<text" in drawing
    assert all(name.startswith(("p", "m")) for name in re.findall(r' id="(\w+)"', drawing))  # clips and markers


def test_every_term_of_the_losses_has_a_readable_name():
    terms = ["total", "mse", "mae", "ssim_loss", "lpips", "stokes", "intensity_lpips", "aolp_ssim_loss"]
    labels = [term_label(term) for term in terms]
    assert labels[-2:] == ["intensity: LPIPS", "AoLP: 1 - SSIM"]
    assert not [label for label in labels if "_" in label]
