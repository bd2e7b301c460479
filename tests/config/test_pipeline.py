import pytest

from polarnet.config import pipeline as benchmarking
from polarnet.config.tree import load


@pytest.mark.parametrize(("enabled", "scored"), [("false", ["simulated"]), ("true", ["simulated", "recordings"])])
def test_real_targets_are_a_set_while_they_are_switched_on(project_root, tmp_path, monkeypatch, enabled, scored):
    ran = {}
    monkeypatch.setattr(benchmarking, "pipeline_set", lambda config, name: name)
    monkeypatch.setattr(benchmarking, "made_set", lambda name, folder: (name, folder))
    monkeypatch.setattr(
        benchmarking, "run_on", lambda config, test_set, lpips, folder: ran.update({test_set: folder}) or {}
    )
    config = load(project_root, [f"paths.data={tmp_path}", f"recordings.enabled={enabled}"])
    assert list(benchmarking.run_pipeline_benchmark(config, None)) == scored
    assert ran["simulated"] == tmp_path / "benchmark"
    if enabled == "true":
        assert ran["recordings", tmp_path / "calibrated"] == tmp_path / "benchmark" / "sets" / "recordings"
