import json

import pytest

from polarnet.reports.artefacts import git
from studies import study
from studies.measure import measure_pipeline
from studies.study import arguments_of, command_line, uncommitted, write_section

IDENTITY = ("-c", "user.name=a", "-c", "user.email=a@b.c")


def commit_all(root):
    git(root, "init", "--quiet")
    git(root, "add", ".")
    git(root, *IDENTITY, "commit", "--quiet", "--allow-empty", "-m", "one")


def test_a_section_of_the_results_is_replaced_and_headlines_join_what_is_there(tmp_path):
    write_section("recordings", "rig", {"captures": 8, "old": 1}, {"commit": "a"}, {"ours": {"a": 1}}, tmp_path)
    write_section("recordings", "readers", {"text": 4}, {"commit": "b"}, {"ours": {"b": 2}}, tmp_path)
    path = write_section("recordings", "rig", {"captures": 32}, {"commit": "c"}, root=tmp_path)
    assert path == tmp_path / "docs" / "results" / "recordings.json"
    assert json.loads(path.read_text()) == {
        "ours": {"a": 1, "b": 2},
        "readers": {"text": 4},
        "records": {"readers": {"commit": "b"}, "rig": {"commit": "c"}},
        "rig": {"captures": 32},
    }


def test_what_is_measured_is_no_change_of_what_it_names(tmp_path):
    files = [tmp_path / name for name in ("docs/results/a.json", "docs/pictures/a.png", "dvc.lock", "code.py")]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("one")
    commit_all(tmp_path)
    for file in files[:3]:
        file.write_text("two")
    assert uncommitted(tmp_path) == ""
    files[3].write_text("two")
    assert "code.py" in uncommitted(tmp_path)
    with pytest.raises(RuntimeError, match="uncommitted changes"):
        measure_pipeline(tmp_path)


def test_figures_of_a_changed_tree_may_be_measured_but_not_written(monkeypatch, capsys):
    monkeypatch.setattr(study, "uncommitted", lambda root: "M code.py")
    monkeypatch.setattr("sys.argv", ["study"])
    assert not arguments_of(command_line("A study.", "docs/results/a.json")).write
    monkeypatch.setattr("sys.argv", ["study", "--write"])
    with pytest.raises(SystemExit):
        arguments_of(command_line("A study.", "docs/results/a.json"))
    assert "commit first, because the figures name a commit; changed:\nM code.py" in capsys.readouterr().err
