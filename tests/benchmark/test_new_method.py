"""A method that one small module adds runs wherever methods run."""

import dataclasses
import re

import pytest

from polarnet import methods
from polarnet.benchmark.results import write_benchmark
from polarnet.benchmark.run import run_benchmark
from polarnet.benchmark.score import BenchmarkConfig
from polarnet.config.pipeline import context_of
from polarnet.config.tree import load
from polarnet.events.streaming import WindowRule
from polarnet.methods import METHODS, ROWS
from polarnet.recordings.arrangements import Piece
from polarnet.recovery.stream import Input, frames_of
from polarnet.reports.tables import score_table

pytestmark = pytest.mark.usefixtures("brief_costs")

EVENT = 0.01
"""DoLP that an event adds at its pixel, in the module that docs/methods.md shows."""


@pytest.fixture
def activity(project_root, tmp_path, monkeypatch):
    """The module of docs/methods.md beside those of polarnet.methods."""
    page = (project_root / "docs" / "methods.md").read_text()
    module = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert module is not None
    (tmp_path / "activity.py").write_text(module[1])
    monkeypatch.setattr(methods, "__path__", [*methods.__path__, str(tmp_path)])
    assembled = methods._assembled()
    assert list(assembled).index("activity") < list(assembled).index("e2v")  # what needs no weights comes first
    monkeypatch.setitem(METHODS, "activity", assembled["activity"])
    return METHODS["activity"]


@pytest.fixture
def with_activity(activity, context, make_setup):
    return dataclasses.replace(context, setups=context.setups | {"activity": make_setup("activity")})


def test_it_is_a_row_of_the_benchmark_with_its_name_in_tables(activity, with_activity, five_scenes, tmp_path):
    config = BenchmarkConfig(["zeros", "activity", "ours"], ["simulated"], 1, "fp32", False, "alex", 20, 1)
    benchmark = run_benchmark(five_scenes, with_activity, config, None)
    metrics = write_benchmark(tmp_path / "out", benchmark, config, 1, {})
    assert set(metrics) == {"zeros", "activity", "ours"}
    assert metrics["activity"]["gflop"] is None
    assert ROWS["activity"].colour == "#123456"
    assert "activity" in [row.label for row in score_table(metrics).rows]


def test_it_needs_no_section_in_the_configuration_and_recover_runs_it(activity, project_root, sequence, make_setup):
    config = load(project_root, ["benchmark.methods=[oracle_mean,activity]"])
    assert context_of(config, ["activity"], None).setups["activity"].config is None
    assert config.used_baselines == []
    channels = sequence.events
    source = Input("test", channels[0].height, channels[0].width, [Piece(channels, 4000, 0.0)])
    frames = list(frames_of(source, WindowRule(1000, None), activity.open(make_setup("activity"))))
    assert [frame.window.stop_us for frame in frames] == [1000, 2000, 3000, 4000]
    assert frames[-1].prediction.dolp.sum().item() == pytest.approx(4 * 300 * EVENT)
