import re

import pytest

from polarnet.benchmark.run import Benchmark
from polarnet.benchmark.score import Cost
from polarnet.config import pipeline, tables
from polarnet.config.tree import load


def scored_rows(rows):
    return Benchmark([], dict.fromkeys(rows, Cost(0.0, None, 0, 0.0)), [])


@pytest.mark.parametrize(("enabled", "scored"), [("false", ["simulated"]), ("true", ["simulated", "recordings"])])
def test_real_targets_are_a_set_while_they_are_switched_on(project_root, tmp_path, monkeypatch, enabled, scored):
    opened, written = [], {}
    monkeypatch.setattr(pipeline, "pipeline_set", lambda config, name, rows: opened.append(name))
    monkeypatch.setattr(
        pipeline, "run_benchmark", lambda test_set, context, settings, *_: scored_rows(settings.methods)
    )
    monkeypatch.setattr(pipeline, "lpips_of", lambda config: None)
    monkeypatch.setattr(pipeline, "write_row", lambda folder, row, record, sets: written.update({row: list(sets)}))
    config = load(project_root, [f"paths.data={tmp_path}", f"recordings.enabled={enabled}"])
    pipeline.run_rows(config, ["zeros", "cf", "rotating_polarizer"])
    assert opened == scored
    assert written == {"zeros": scored, "cf": scored, "rotating_polarizer": ["simulated"]}  # targets: four channels
    assert pipeline.set_folder(config, "simulated") == tmp_path / "benchmark"
    assert pipeline.set_folder(config, "recordings") == tmp_path / "benchmark" / "sets" / "recordings"


def test_a_row_without_weights_is_recorded_without_opening_a_test_set(project_root, tmp_path):
    config = load(project_root, [f"paths.data={tmp_path}"])
    pipeline.run_rows(config, ["e2p"])
    row = tmp_path / "benchmark" / "rows" / "e2p"
    assert {file.name for file in row.iterdir()} == {"row.json", "SHA256SUMS"}
    assert "best.safetensors is not there" in (row / "row.json").read_text()
    with pytest.raises(ValueError, match="expected at least one row that can run, got none"):
        tables.collect_rows(load(project_root, [f"paths.data={tmp_path}", "benchmark.methods=[e2p]"]))


@pytest.mark.parametrize("row", ["e2v", "firenet", "e2vid", "e2v+gain", "firenet+gain"])
def test_every_row_of_the_trained_intensity_network_asks_for_its_training(project_root, row):
    assert load(project_root, [f"benchmark.methods=[zeros,{row}]"]).used_baselines == ["e2v"]


def test_a_row_with_a_file_of_its_own_asks_for_no_training(project_root):
    given = "methods.e2v.weights=mine.safetensors"
    assert load(project_root, ["benchmark.methods=[e2v,e2v+gain]", given]).used_baselines == []
    assert load(project_root, ["benchmark.methods=[e2v,firenet]", given]).used_baselines == ["e2v"]


def test_rows_of_published_weights_ask_for_no_training(project_root):
    rows = "benchmark.methods=[cf,firenet_published,firenet_published+gain,paper,ours]"
    assert load(project_root, [rows]).used_baselines == []


def test_a_baseline_that_no_row_uses_is_not_trained(project_root):
    with pytest.raises(ValueError, match=r"no row of benchmark.methods uses the weights of baselines.e2p.*add e2p to"):
        load(project_root, ["baseline=e2p"])


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("rows.cf.module=polarnet/methods/e2v.py", "rows.cf.module: expected polarnet/methods/complementary_filter.py"),
        ("rows.highpass.settings=methods.cf", "rows.highpass.settings: expected methods.highpass"),
        ("rows.ours.needs=data/train/e2v", "rows.ours.needs: expected data/train/ours"),
        ("rows.zeros.module=polarnet/stokes.py", "rows.zeros.module: expected polarnet/benchmark/references.py"),
        ("~rows.cf.needs", "rows.cf.needs: expected a value, got none; add the key"),
    ],
)
def test_a_row_that_declares_less_than_it_uses_is_refused(project_root, change, expected):
    with pytest.raises(ValueError, match=re.escape(expected)):
        load(project_root, [change])


def test_a_row_whose_weights_no_stage_trains_is_refused(project_root):
    with pytest.raises(
        ValueError, match=r"rows.e2v.needs: no stage makes data/train/e2v; add e2v to baselines.trained"
    ):
        load(project_root, ["baselines.trained=[]"])
