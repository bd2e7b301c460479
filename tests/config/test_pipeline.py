import re
from pathlib import Path

import pytest

from polarnet.benchmark.run import Benchmark
from polarnet.benchmark.score import Cost
from polarnet.config import pipeline, tables
from polarnet.config.tree import load


def scored_rows(rows):
    return Benchmark([], dict.fromkeys(rows, Cost(0.0, None, 0)), [])


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
    assert pipeline.set_folder(config, "simulated") == tmp_path / "benchmark" / "sets" / "simulated"
    assert pipeline.set_folder(config, "recordings") == tmp_path / "benchmark" / "sets" / "recordings"


def test_a_row_without_weights_is_recorded_without_opening_a_test_set(project_root, tmp_path):
    config = load(project_root, [f"paths.data={tmp_path}"])
    pipeline.run_rows(config, ["e2p"])
    row = tmp_path / "benchmark" / "rows" / "e2p"
    assert {file.name for file in row.iterdir()} == {"row.json", "SHA256SUMS"}
    assert "no weights are given: add the row to section `rows`" in (row / "row.json").read_text()
    with pytest.raises(ValueError, match="expected at least one row that can run, got none"):
        tables.collect_rows(load(project_root, [f"paths.data={tmp_path}", "benchmark.methods=[e2p]"]))


def test_a_baseline_is_trained_for_a_row_that_needs_it_and_not_for_one_with_a_file_of_its_own(project_root):
    assert load(project_root).used_baselines == ["e2v"]
    assert load(project_root, ["rows.e2v.needs=data/external/mine.safetensors"]).used_baselines == []
    assert load(project_root, ["benchmark.methods=[cf,ours]"]).used_baselines == []
    unused = r"no row of benchmark.methods uses the weights of baselines.e2p.*data/train/e2p"
    with pytest.raises(ValueError, match=unused):
        load(project_root, ["baseline=e2p"])


def test_a_row_takes_the_weights_that_its_entry_names(project_root, tmp_path):
    config = load(project_root, [f"paths.train={tmp_path}", "rows.e2v.needs=data/external/mine.safetensors"])
    assert config.weights_of("ours") == tmp_path / "ours" / "best.safetensors"
    assert config.weights_of("e2v") == Path("data/external/mine.safetensors")
    assert config.weights_of("e2p") is None


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("rows.highpass.settings=methods.cf", "rows.highpass.settings: expected methods.highpass, which the row reads"),
        ("~rows.cf.needs", "rows.cf.needs: expected a value, got none; add the key"),
        ("baselines.trained=[]", "rows.e2v.needs: no stage makes data/train/e2v; add e2v to baselines.trained"),
        ("train.start=outputs/a.safetensors", "train.start: expected a file below data/external/start, whose content"),
    ],
)
def test_a_value_whose_file_or_section_dvc_would_not_follow_is_refused(project_root, change, expected):
    with pytest.raises(ValueError, match=re.escape(expected)):
        load(project_root, [change])
