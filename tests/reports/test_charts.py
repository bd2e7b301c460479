import re

import pytest

from polarnet.reports.charts import (
    error_chart,
    reliability_chart,
    sweep_chart,
)
from polarnet.reports.figures import svg
from polarnet.reports.legend import GENERAL

METRICS = {
    "oracle_mean": {"mse": 0.03, "mse_ci": [0.02, 0.04]},
    "ours": {"mse": 0.02, "mse_ci": [0.01, 0.03]},
}


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
