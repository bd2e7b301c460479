from pathlib import Path

import pytest

from studies import measure
from studies.measure import STAGE_OUTPUTS, run_missing
from studies.seeds import CONDITIONS, FIGURES, means, row_of, trained


@pytest.fixture
def ran(monkeypatch):
    """Stages that ran, with their overrides; each leaves its output."""
    calls: list[tuple[str, tuple[str, ...]]] = []

    def run_stage(name, *overrides):
        calls.append((name, overrides))
        (folder,) = (one.partition("=")[2] for one in overrides if one.startswith("paths.data="))
        output = Path(folder) / STAGE_OUTPUTS[name]
        output.parent.mkdir(parents=True, exist_ok=True)
        output.touch()

    monkeypatch.setattr(measure, "run_stage", run_stage)
    return calls


def test_both_trainings_run_once_and_the_second_starts_from_the_first(ran, tmp_path):
    weights = trained(2, tmp_path / "photographs", tmp_path)
    first = tmp_path / "shipped" / "train" / "ours" / "best.safetensors"
    assert [name for name, _ in ran] == 2 * ["ingest", "synthesize", "emulate", "train"]
    assert [f"train.start={first}" in overrides for _, overrides in ran] == 4 * [False] + 4 * [True]
    assert all("seed=2" in overrides for _, overrides in ran)
    assert weights == tmp_path / "shipped_whole" / "train" / "ours" / "best.safetensors"
    assert trained(2, tmp_path / "photographs", tmp_path) == weights
    assert len(ran) == 8


def test_missing_stages_run_as_far_as_asked(ran, tmp_path):
    (tmp_path / "images").mkdir()
    assert run_missing(tmp_path, "seed=1", until="emulate") == tmp_path / "events.zarr"
    assert [name for name, _ in ran] == ["synthesize", "emulate"]
    with pytest.raises(ValueError, match="until: expected one of ingest, synthesize, emulate, train, got 'report'"):
        run_missing(tmp_path, until="report")
    assert len(ran) == 2


def test_a_training_that_was_cut_off_after_its_first_checkpoint_is_resumed(ran, tmp_path):
    running = tmp_path / "resume" / "0123456789abcdef" / "running.pt"
    running.parent.mkdir(parents=True)
    running.touch()
    run_missing(tmp_path)
    run_missing(tmp_path)
    assert [name for name, _ in ran] == ["ingest", "synthesize", "emulate", "train", "train"]
    running.unlink()
    run_missing(tmp_path)
    assert len(ran) == 5


def test_the_mean_is_over_networks_for_each_condition_and_figure():
    tables = {
        name: {"rows": {"a": dict.fromkeys(FIGURES, 1.0) | {"other": 5.0}, "b": dict.fromkeys(FIGURES, 2.0 + place)}}
        for place, name in enumerate(CONDITIONS)
    }
    mean = means([row_of(tables, "a"), row_of(tables, "b")])
    assert [mean[name]["mse"] for name in CONDITIONS] == [1.5, 2.0, 2.5]
    assert set(mean["measured"]) == set(FIGURES)
