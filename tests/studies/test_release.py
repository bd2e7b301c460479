import json

import pytest

from studies import release, study


@pytest.fixture
def results(tmp_path, monkeypatch):
    """A project with two measurements of commit a and one of commit b."""
    folder = tmp_path / "docs" / "results"
    folder.mkdir(parents=True)
    records = {"speed": {"live": "a", "turns": "b"}, "camera": {"defects": "a"}}
    for name, sections in records.items():
        of_file = {"records": {section: {"commit": commit} for section, commit in sections.items()}}
        (folder / f"{name}.json").write_text(json.dumps(of_file))
    (tmp_path / "README.md").write_text("one\ntwo\n")
    (tmp_path / "docs" / "index.md").write_text("three\n")
    for module in (release, study):
        monkeypatch.setattr(module, "ROOT", tmp_path)
    return tmp_path


def test_a_release_counts_its_tables_and_those_of_other_commits(results, monkeypatch):
    monkeypatch.setattr(release, "download_mb", lambda *requirements: 550)
    assert release.release("a") == {
        "commit": "a", "tables": 3, "tables_of_other_commits": 1, "readme_lines": 2, "docs_lines": 1,
        "install_mb_cpu": 550,
    }  # fmt: skip


def test_only_what_another_commit_measured_is_measured_again(results, monkeypatch, capsys):
    commands = []
    monkeypatch.setattr(release, "machine_record", lambda: {"commit": "a"})
    monkeypatch.setattr(release.subprocess, "run", lambda command, **_: commands.append(command[1:]))
    monkeypatch.setattr(release, "release", lambda commit: {"commit": commit})
    monkeypatch.setattr("sys.argv", ["release", "--shared", "s", "--work", "w", "--only", "camera", "speed", "light"])
    release.main()
    assert commands == [["-m", "studies.light"]]
    assert "light, dolp: python -m studies.light" in capsys.readouterr().out


def test_every_study_of_the_release_is_a_module_and_names_a_file_of_results():
    names = {path.stem for path in (study.ROOT / "docs" / "results").glob("*.json")}
    for (name, _), words in release.STUDIES.items():
        assert name in names
        assert (study.ROOT / "studies" / f"{words.split()[0].removeprefix('studies.')}.py").is_file()
