import pytest

from polarnet.measure import _timed, machine_record, measure_pipeline
from polarnet.reports.provenance import git


def test_the_minutes_of_a_target_are_those_of_its_stages(tmp_path):
    (tmp_path / "Makefile").write_text(
        "two:\n\t@echo \"Running stage 'ingest':\"\n\t@sleep 0.7\n\t@echo \"Running stage 'train':\"\n\t@sleep 0.7\n"
        "none:\n\t@echo nothing to do\n"
        "broken:\n\t@exit 3\n"
    )
    minutes, stages = _timed("two", tmp_path)
    assert list(stages) == ["ingest", "train"]
    assert all(value == 0.01 for value in stages.values())  # 0.7 s, to a hundredth of a minute
    assert minutes == pytest.approx(sum(stages.values()), abs=0.011)
    assert _timed("none", tmp_path)[1] == {}
    with pytest.raises(RuntimeError, match="make broken failed in a fresh clone"):
        _timed("broken", tmp_path)


def test_figures_name_their_machine_and_commit(project_root):
    record = machine_record(project_root)
    assert set(record) == {"machine", "cores", "load", "versions", "commit"}
    assert record["commit"] == git(project_root, "rev-parse", "HEAD")


def test_a_tree_with_changes_is_not_measured(tmp_path):
    git(tmp_path, "init", "--quiet")
    (tmp_path / "file").write_text("one")
    git(tmp_path, "add", "file")
    with pytest.raises(RuntimeError, match="uncommitted changes"):
        measure_pipeline(tmp_path)
