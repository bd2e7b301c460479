import json

import pytest

from polarnet.reports.artefacts import git
from studies import measure, study
from studies.study import arguments_of, command_line, uncommitted, write_section

IDENTITY = ("-c", "user.name=a", "-c", "user.email=a@b.c")


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project with two measurements of commit a and one of commit b."""
    records = {"speed": {"live": "a", "turns": "b"}, "camera": {"defects": "a"}}
    for name, sections in records.items():
        of_file = {"records": {section: {"commit": commit} for section, commit in sections.items()}}
        (tmp_path / "docs" / "results").mkdir(parents=True, exist_ok=True)
        (tmp_path / "docs" / "results" / f"{name}.json").write_text(json.dumps(of_file))
    (tmp_path / "README.md").write_text("one\ntwo\n")
    (tmp_path / "docs" / "index.md").write_text("three\n")
    for module in (measure, study):
        monkeypatch.setattr(module, "ROOT", tmp_path)
    return tmp_path


def commit_all(root):
    git(root, "init", "--quiet")
    git(root, "add", ".")
    git(root, *IDENTITY, "commit", "--quiet", "-m", "one")


def test_a_section_of_the_results_is_replaced_and_headlines_join_what_is_there(project):
    write_section("recordings", "rig", {"captures": 8, "old": 1}, {"commit": "a"}, {"ours": {"a": 1}})
    write_section("recordings", "readers", {"text": 4}, {"commit": "b"}, {"ours": {"b": 2}})
    path = write_section("recordings", "rig", {"captures": 32}, {"commit": "c"})
    assert path == project / "docs" / "results" / "recordings.json"
    assert json.loads(path.read_text()) == {
        "ours": {"a": 1, "b": 2},
        "readers": {"text": 4},
        "records": {"readers": {"commit": "b"}, "rig": {"commit": "c"}},
        "rig": {"captures": 32},
    }


def test_figures_of_a_changed_tree_may_be_measured_but_not_written_unless_only_measurements_changed(
    project, monkeypatch, capsys
):
    files = [project / name for name in ("docs/results/a.json", "docs/pictures/a.png", "dvc.lock", "code.py")]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("one")
    commit_all(project)
    for file in files[:3]:
        file.write_text("two")
    assert uncommitted() == ""
    files[3].write_text("two")
    monkeypatch.setattr("sys.argv", ["study"])
    assert not arguments_of(command_line("A study.", "docs/results/a.json")).write
    for command, main in (
        (["study", "--write"], lambda: arguments_of(command_line("A study.", "docs/results/a.json"))),
        (["measure", "pipeline"], measure.main),
    ):
        monkeypatch.setattr("sys.argv", command)
        with pytest.raises(SystemExit):
            main()
        assert "commit first, because the figures name a commit; changed:\nM code.py" in capsys.readouterr().err


def test_a_release_measures_what_another_commit_measured_and_counts_its_tables(project, monkeypatch, capsys):
    commands = []
    monkeypatch.setattr(measure, "machine_record", lambda: {"commit": "a"})
    monkeypatch.setattr(measure, "download_mb", lambda *requirements: 550)
    monkeypatch.setattr(measure.subprocess, "run", lambda command, **_: commands.append(command[1:]))
    path = measure.measure_release(project, project, ["camera", "speed", "light"])
    assert commands == [["-m", "studies.camera", "--only", "events", "dolp", "--write"]]
    assert "light, dolp: python -m studies.camera" in capsys.readouterr().out
    figures = json.loads(path.read_text())
    del figures["records"], figures["release"]
    assert figures == {
        "commit": "a", "tables": 3, "tables_of_other_commits": 1, "readme_lines": 2, "docs_lines": 1,
        "install_mb_cpu": 550,
    }  # fmt: skip


def test_every_study_of_the_release_is_a_module_and_names_a_file_of_results():
    names = {path.stem for path in (study.ROOT / "docs" / "results").glob("*.json")}
    for (name, _), words in measure.STUDIES.items():
        assert name in names
        assert (study.ROOT / "studies" / f"{words.split()[0].removeprefix('studies.')}.py").is_file()
