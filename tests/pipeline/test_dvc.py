"""dvc.yaml: a stage depends on the code that makes its outputs; a row of the tables on no other row's."""

import contextlib
import functools
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grimp
import pytest
from ruamel.yaml import YAML

from polarnet.config.experiments import stage_names
from polarnet.methods import METHODS, module_of
from polarnet.training.baselines import BASELINES

# Code that starts a stage and checks its values decides no output; listed, it would re-run all at each new setting.
PLUMBING = {"polarnet", "polarnet.config.tree", "polarnet.runtime.cluster"}
ASSEMBLED = {"polarnet.methods", "polarnet.training.baselines", "polarnet.benchmark.references"}
"""Modules that collect entries by name; a row or a training depends on its own entry alone."""
SIMULATION = ("ingest", "synthesize", "emulate")
REPORT_OUTS = ("metrics.json", "cost.json", "details.json", "frames.csv", "panels", "sets")


@pytest.fixture(scope="module")
def imports() -> grimp.ImportGraph:
    return grimp.build_graph("polarnet", "stages", cache_dir=None)


@pytest.fixture(scope="module")
def stages(project_root: Path) -> dict[str, dict[str, Any]]:
    """Stages by name, as DVC resolves dvc.yaml and params.yaml."""
    from dvc.repo import Repo

    with Repo(str(project_root)) as repo:
        return {
            stage.name: {
                "cmd": stage.cmd,
                "deps": [dep.def_path for dep in stage.deps if not hasattr(dep, "params")],
                "params": {key for dep in stage.deps if hasattr(dep, "params") for key in dep.params},
                "outs": [out.def_path for out in stage.outs],
            }
            for stage in repo.index.stages
        }


def reached(starts: list[str], imports: grimp.ImportGraph, ends: set[str] = frozenset()) -> set[str]:
    """Modules that `starts` import, directly or not, with those in `ends` but not what these import."""
    modules: set[str] = set()
    waiting = list(starts)
    while waiting:
        module = waiting.pop()
        if module not in modules | PLUMBING:
            modules.add(module)
            if module not in ends:
                waiting += imports.find_modules_directly_imported_by(module)
    return modules


def modules_behind(stage: str, cmd: str, imports: grimp.ImportGraph) -> set[str]:
    """Modules that decide the outputs of a stage."""
    script = cmd.split()[2]
    if stage.startswith("benchmark@"):
        return reached([script], imports, ASSEMBLED | {"polarnet.networks.registry"}) - ASSEMBLED | {"polarnet.methods"}
    if stage.startswith("train_baseline@"):
        own = [f"polarnet.training.{stage.partition('@')[2]}"]
        return reached([script, *own], imports, {"polarnet.training.dolp", "polarnet.networks.registry"})
    if stage == "report":
        return reached([script, *imports.find_children("polarnet.methods")], imports)
    return reached([script], imports)


def listed(root: Path, deps: list[str]) -> set[str]:
    """Modules in the files and folders of code among the dependencies."""
    names: set[str] = set()
    for dep in deps:
        if dep.startswith(("polarnet/", "stages/")):
            path = root / dep
            files = list(path.rglob("*.py")) if path.is_dir() else [path]
            assert files, f"{dep} holds no module"
            assert all(file.exists() for file in files), f"{dep} is not there"
            names |= {".".join(file.relative_to(root).with_suffix("").parts) for file in files}
    return {name.removesuffix(".__init__") for name in names}


def test_every_module_that_a_stage_imports_is_in_a_file_or_folder_among_its_dependencies(project_root, stages, imports):
    entries = {"polarnet.training.dolp", "polarnet.networks.registry"}  # of other trainings and rows than this one's
    for stage, content in stages.items():
        missing = modules_behind(stage, content["cmd"], imports) - listed(project_root, content["deps"])
        if "@" in stage:
            missing -= entries
        assert not missing, f"{stage}: dvc.yaml lacks {sorted(missing)}"


def test_a_folder_or_file_that_a_stage_lists_is_imported_by_it(project_root, stages, imports):
    for stage, content in stages.items():
        behind = modules_behind(stage, content["cmd"], imports)
        for dep in content["deps"]:
            if dep.startswith(("polarnet/", "stages/")) and "@" not in stage:
                assert listed(project_root, [dep]) & behind, f"{stage} needs nothing of {dep}"


def test_a_change_of_network_loss_metric_or_figure_never_reruns_the_simulation(stages):
    for stage in SIMULATION:
        rooms = {Path(dep).parts[1] for dep in stages[stage]["deps"] if dep.startswith("polarnet/")}
        assert not rooms & {"networks", "training", "metrics", "methods", "benchmark", "reports"}, stage


def test_a_row_depends_on_the_file_of_its_method_on_its_settings_and_on_its_training(stages, project_root):
    rows = YAML(typ="safe").load(project_root / "params.yaml")["rows"]
    for row in rows:
        stage = stages[f"benchmark@{row}"]
        if row not in METHODS:
            assert "polarnet/benchmark/references.py" in stage["deps"]
            continue
        method = METHODS[row]
        assert f"{module_of(row).replace('.', '/')}.py" in stage["deps"]
        assert f"methods.{method.section}" in stage["params"]
        if method.weights is not None and method.weights.trained_by:
            assert f"data/train/{method.weights.trained_by}" in stage["deps"]


def test_no_row_depends_on_the_file_settings_or_training_of_another(stages, project_root):
    rows = YAML(typ="safe").load(project_root / "params.yaml")["rows"]
    modules = {keys["module"] for keys in rows.values()}
    for row, keys in rows.items():
        stage = stages[f"benchmark@{row}"]
        assert modules & set(stage["deps"]) == {keys["module"]}
        assert {key for key in stage["params"] if key.startswith("methods")} <= {keys["settings"]}
        assert {dep for dep in stage["deps"] if dep.startswith("data/train")} <= {keys["needs"]}
        assert not {"rows", "methods", "benchmark", "benchmark.methods"} & stage["params"]
        assert not {"polarnet/methods", "polarnet/networks", "polarnet/benchmark"} & set(stage["deps"])


def test_a_training_depends_on_no_file_or_setting_of_a_row_or_of_another_training(stages):
    for stage in ("train", *(f"train_baseline@{name}" for name in BASELINES if f"train_baseline@{name}" in stages)):
        content = stages[stage]
        assert not any(dep.startswith(("polarnet/methods", "polarnet/benchmark")) for dep in content["deps"])
        assert not {"polarnet/training", "polarnet/networks"} & set(content["deps"])
        assert not any(key.startswith(("rows", "methods", "benchmark")) for key in content["params"])


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
    outs = {
        "ingest": ["images"], "synthesize": ["scenes.zarr", "frames.zarr"], "emulate": ["events.zarr"],
        "weights": ["weights/loss.json", "weights/benchmark.json"], "train": ["train/NAME"], "sets": ["sets"],
        "emulate_rotating": ["rotating"],
        "import_recordings": ["imported"], "calibrate": ["calibrated"], "row": ["benchmark/rows/NAME"],
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
        assert repro() == set(stage_names(folder))
    return folder


@pytest.fixture
def project(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the finished project, as the working directory."""
    shutil.copytree(finished, tmp_path / "project")
    enter(tmp_path / "project", monkeypatch)
    return tmp_path / "project"


@pytest.fixture(scope="module")
def edited(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the finished project for tests that change one file each and run what that makes stale."""
    return Path(shutil.copytree(finished, tmp_path_factory.mktemp("edited") / "project"))


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
    file.write_text(file.read_text() + "\nCHANGED = True\n" if file.exists() else "NEW = True\n")


def test_a_second_run_has_nothing_to_do(project):
    assert repro() == set()


def test_a_new_method_runs_itself_and_the_report_and_nothing_else(project):
    def add(params):
        params["methods"]["sobel"] = {"weights": None}
        params["rows"]["sobel"] = {
            "module": "polarnet/methods/sobel.py", "needs": "polarnet/networks/sobel.py", "settings": "methods.sobel"
        }  # fmt: skip

    for room in ("methods", "networks"):
        append(project / "polarnet" / room / "sobel.py")
    set_params(project, add)
    assert repro() == {"benchmark@sobel", "report"}


def test_a_new_trained_baseline_trains_itself_and_runs_itself_and_no_other_training_or_row(project):
    def add(params):
        params["methods"]["sobel"] = {"weights": None}
        params["baselines"]["sobel"] = {"epochs": 1}
        params["baselines"]["trained"].append("sobel")
        params["rows"]["sobel"] = {
            "module": "polarnet/methods/sobel.py", "needs": "data/train/sobel", "settings": "methods.sobel"
        }  # fmt: skip

    for room in ("methods", "networks", "training"):
        append(project / "polarnet" / room / "sobel.py")
    set_params(project, add)
    weights = {"weights"}  # looks whether the new loss needs LPIPS; what it writes stays the same
    assert repro() == weights | {"train_baseline@sobel", "benchmark@sobel", "report"}


@pytest.mark.thorough
def test_a_changed_setting_of_a_method_runs_its_rows_and_the_report(project):
    set_params(project, lambda params: params["methods"]["cf"].update(cutoff_hz=1.0))
    assert repro() == {"benchmark@cf", "benchmark@cf+gain", "report"}


@pytest.mark.thorough
def test_a_row_that_is_added_or_removed_runs_no_other_row(project):
    removed: dict[str, Any] = {}
    set_params(project, lambda params: removed.update(params["rows"].pop("highpass")))
    assert repro() == {"report"}
    set_params(project, lambda params: params["rows"].update(firenet_published=removed))
    assert repro() == {"benchmark@firenet_published", "report"}


thorough = functools.partial(pytest.param, marks=pytest.mark.thorough)


@pytest.mark.parametrize(
    ("file", "stages"),
    [
        ("methods/e2v.py", {"benchmark@e2v", "report"}),
        ("networks/firenet.py", {"train_baseline@e2v", "report"}),
        ("cli/recordings.py", set()),
        thorough("methods/complementary_filter.py", {"benchmark@cf", "benchmark@highpass", "benchmark@cf+gain",
                                                     "benchmark@highpass+gain", "report"}),
        thorough("networks/stokes_unet.py", {"train", "report"}),
        thorough("networks/cista_tc.py", {"report"}),
        thorough("reports/figures.py", {"report"}),
        thorough("benchmark/paired.py", {"report"}),
    ],
)  # fmt: skip
def test_a_changed_file_runs_what_it_decides_and_weights_that_stay_the_same_run_no_row(
    edited, monkeypatch, file, stages
):
    enter(edited, monkeypatch)
    append(edited / "polarnet" / file)
    assert repro() == stages
