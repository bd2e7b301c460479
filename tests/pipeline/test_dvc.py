"""dvc.yaml, with real DVC and stand-ins for the stages: which stages an edit of code, values or files runs again."""

import contextlib
import functools
import json
import operator
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from polarnet.config.origins import pipeline

SIMULATION = ("ingest", "synthesize", "emulate")
REPORT_OUTS = ("metrics.json", "history", "sets")
ROWS = {f"benchmark@{row}" for row in YAML(typ="safe").load(Path(__file__).parents[2] / "params.yaml")["rows"]}
TRAININGS = {"train", "train_baseline@e2v"}


def test_the_stages_of_a_run_by_hand_are_those_of_dvc(project_root: Path):
    from dvc.repo import Repo

    own = pipeline(project_root, YAML(typ="safe").load(project_root / "params.yaml"))
    with Repo(str(project_root)) as repo:
        stages = {stage.name: stage for stage in repo.index.stages}
    assert set(own) == set(stages)
    for name, stage in stages.items():
        deps = {dep.def_path for dep in stage.deps if not hasattr(dep, "params")}
        params = {key for dep in stage.deps if hasattr(dep, "params") for key in dep.params}
        assert (set(own[name].deps), set(own[name].params)) == (deps, params), name
        assert (" ".join(own[name].command), set(own[name].outs)) == (stage.cmd, {out.def_path for out in stage.outs})


def test_a_change_of_network_loss_metric_or_figure_never_reruns_the_simulation(project_root: Path):
    stages = pipeline(project_root, YAML(typ="safe").load(project_root / "params.yaml"))
    for name in SIMULATION:
        rooms = {Path(dep).parts[1] for dep in stages[name].deps if dep.startswith("polarnet/")}
        assert not rooms & {"networks", "training", "metrics", "methods", "benchmark", "reports"}, name


STAND_IN = """
import pathlib, sys
name = sys.argv[1].partition("=")[2] if len(sys.argv) > 1 else "ours"
for out in {outs}:
    path = pathlib.Path(out.replace("NAME", name))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(name)
"""
"""A stage that reads nothing and always writes the same."""


@pytest.fixture(scope="module")
def finished(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """This project's dvc.yaml, params.yaml and code, with stand-ins for the stages, after one `dvc repro`."""
    from dvc.repo import Repo

    folder = tmp_path_factory.mktemp("finished") / "project"
    folder.mkdir()
    for name in ("dvc.yaml", "params.yaml", ".dvcignore"):
        shutil.copy(project_root / name, folder / name)
    shutil.copytree(project_root / "polarnet", folder / "polarnet", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("measured", "photographs", "recordings"):
        (folder / "data" / name).mkdir(parents=True)
        (folder / "data" / name / "README.md").touch()
    (folder / "data" / "external" / "start").mkdir(parents=True)
    outs = {
        "ingest": ["images"], "synthesize": ["scenes.zarr", "frames.zarr"], "emulate": ["events.zarr"],
        "train": ["train/NAME"], "sets": ["sets"],
        "emulate_rotating": ["rotating"],
        "calibrate": ["calibrated"], "row": ["benchmark/rows/NAME"],
        "report": [*(f"benchmark/{file}" for file in REPORT_OUTS), "report"],
    }  # fmt: skip
    (folder / "stages").mkdir()
    (folder / "stages" / "__init__.py").touch()  # else Python would take the project's package of this name
    for stage, paths in outs.items():
        code = STAND_IN.format(outs=[f"data/{path}" for path in paths])
        (folder / "stages" / f"{stage}.py").write_text(code)
    Repo.init(str(folder), no_scm=True).close()
    with pytest.MonkeyPatch.context() as monkeypatch:
        enter(folder, monkeypatch)
        assert repro() == set(pipeline(folder, YAML(typ="safe").load(folder / "params.yaml")))
    return folder


@pytest.fixture
def project(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the finished project, as the working directory."""
    shutil.copytree(finished, tmp_path / "project")
    enter(tmp_path / "project", monkeypatch)
    return tmp_path / "project"


@contextlib.contextmanager
def modify_json(path: str, fs: object = None) -> Iterator[dict[str, Any]]:
    """The content of dvc.lock to change, written as JSON, which is YAML too."""
    file = Path(path)
    data = json.loads(file.read_text()) if file.exists() else {}
    yield data
    file.write_text(json.dumps(data))


def enter(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in `folder`, whose stages run by this Python; DVC needs no second to note in dvc.lock that one has run."""
    monkeypatch.setattr("dvc.dvcfile.modify_yaml", modify_json)
    monkeypatch.chdir(folder)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")


def repro() -> set[str]:
    """Names of the stages that `dvc repro` runs in the current folder."""
    from dvc.repo import Repo

    with Repo() as repo:
        return {stage.name for stage in repo.reproduce()}


def set_params(project: Path, change: Callable[[Any], None]) -> None:
    yaml = YAML()
    params = yaml.load(project / "params.yaml")
    change(params)
    yaml.dump(params, project / "params.yaml")


def append(file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(file.read_text() + "\nCHANGED = True\n" if file.exists() else "NEW = True\n")


@pytest.mark.thorough
def test_a_second_run_has_nothing_to_do_nor_one_after_changes_that_no_stage_reads(project):
    for file in ("terminal/progress.py", "cli/doctor.py"):
        append(project / "polarnet" / file)
    set_params(project, put("networks.paper", swin_depth=3))
    assert repro() == set()


@pytest.mark.thorough
def test_a_new_trained_baseline_trains_itself_and_no_other_training(project):
    def add(params):
        params["baselines"]["sobel"] = {"epochs": 1}
        params["baselines"]["trained"].append("sobel")
        params["rows"]["sobel"] = {"needs": "data/train/sobel", "settings": "benchmark.precision"}

    for file in ("methods/sobel.py", "networks/sobel/network.py", "training/sobel.py"):
        append(project / "polarnet" / file)
    set_params(project, add)
    # emulate_rotating looks whether it is needed; what it writes stays the same
    assert repro() == {"train_baseline@sobel", "benchmark@sobel", "report", "emulate_rotating"} | ROWS


FROM_SIMULATION = {*SIMULATION, "sets", "emulate_rotating", "report"}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("file", "stages"),
    [
        ("methods/overlap.py", ROWS | {"report"}),
        ("networks/polarnet/panorama.py", {"train", "report"} | ROWS),
        ("networks/e2v/network.py", {"train_baseline@e2v", "report"} | ROWS),
        ("networks/registry.py", {"report"} | ROWS),
        ("training/dolp.py", {"train"}),
        ("simulation/pixels/exact.py", (FROM_SIMULATION | ROWS) - {"ingest"}),
        ("metrics/similarity.py", {"report"} | TRAININGS | ROWS),
        ("reports/figures.py", {"calibrate", "report"}),
        ("benchmark/results.py", {"report"} | ROWS),
    ],
)
def test_a_changed_file_runs_what_it_can_change(project, file, stages):
    append(project / "polarnet" / file)
    assert repro() == stages


OF_ALL_METHODS = {"benchmark@cf+gain", "benchmark@highpass+gain", "benchmark@registered"}
"""Rows that read two sections of `methods`, and so all of them."""


def put(section: str, **values: Any) -> Callable[[Any], None]:
    """An edit of some keys of a section."""
    return lambda params: functools.reduce(operator.getitem, section.split("."), params).update(values)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("change", "stages"),
    [
        (put("methods.gain", rounds=3), OF_ALL_METHODS | {"report"}),
        (put("baselines.e2v", epochs=2), {"train_baseline@e2v", "report"}),
        (put("methods.cf", cutoff_hz=1.0), OF_ALL_METHODS | {"benchmark@cf", "report"}),
        (put("loss", mse=12.0), {"train", "report"}),
        (put("benchmark", bootstrap_samples=100), {"report"}),
        (put("emulate", cutoff_hz=200.0), {"emulate", "sets", "emulate_rotating", "report"}),
        (lambda params: params["rows"].pop("highpass"), {"emulate_rotating", "report"}),
    ],
)  # fmt: skip
def test_a_changed_value_runs_what_it_can_change(project, change, stages):
    set_params(project, change)
    assert repro() == stages


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("file", "values", "stages"),
    [
        ("data/external/start/net.safetensors", put("train", start="data/external/start/net.safetensors"), {"train"}),
        ("weights/e2v.pth", put("rows.e2v", needs="weights/e2v.pth"), {"benchmark@e2v"}),
    ],
)
def test_new_content_of_a_file_that_a_value_names_runs_the_stage_that_reads_it(project, file, values, stages):
    (project / file).parent.mkdir(parents=True, exist_ok=True)
    (project / file).write_text("one")
    set_params(project, values)
    repro()
    (project / file).write_text("another")
    assert repro() == stages
