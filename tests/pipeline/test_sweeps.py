"""Sweeps of `stages.trial` in a project of their own, whose folder has a space and brackets in its name."""

import functools
import json
import operator
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from ruamel.yaml import YAML
from test_stages import TINY

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def project(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project with toy values in params.yaml, after the stages before the trainings."""
    root = tmp_path_factory.mktemp("drive") / "My Drive (1)" / "project"
    for name in ("polarnet", "stages", "conf"):
        shutil.copytree(project_root / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(project_root / "dvc.yaml", root)
    params = YAML().load(project_root / "params.yaml")
    for override in TINY:
        key, _, value = override.partition("=")
        *sections, last = key.removeprefix("+").split(".")
        if sections[0] not in ("runtime", "rows") and key not in ("benchmark.methods", "baselines.trained"):
            functools.reduce(operator.getitem, sections, params)[last] = yaml.safe_load(value)
    YAML().dump(params, root / "params.yaml")
    for stage in ("ingest", "synthesize", "emulate", "calibrate", "sets"):
        assert (done := python(root, stage)).returncode == 0, done.stderr
    return root


def python(root: Path, stage: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """`python -m stages.STAGE` in the project."""
    command = [sys.executable, "-m", f"stages.{stage}", *arguments]
    return subprocess.run(command, cwd=root, env=environment(root), capture_output=True, text=True)


def environment(root: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(root)}


def sweep(root: Path, *arguments: str) -> list[str]:
    """Lines that a finished sweep printed about its points."""
    done = python(root, "trial", "-m", *arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    return [line for line in done.stdout.splitlines() if " is finished already" in line or " runs: " in line]


def test_a_stopped_sweep_continues_and_an_edited_value_runs_every_point_again(project):
    command = ["loss.ssim=0.0,1.0", "hydra.sweep.dir=outputs/a", "hydra.sweep.subdir=${hydra.job.override_dirname}"]
    first = project / "outputs" / "a" / "loss.ssim=0.0"
    with subprocess.Popen(
        [sys.executable, "-m", "stages.trial", "-m", *command], cwd=project, env=environment(project), text=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ) as stopped:  # fmt: skip
        while not (first / "finished.json").exists():
            assert stopped.poll() is None
            time.sleep(0.1)
        stopped.kill()
    kept = (first / "train" / "ours" / "best.safetensors").stat().st_mtime_ns
    finished, other = sweep(project, *command)
    assert finished == f"{first} is finished already"
    assert other.startswith(f"{first.with_name('loss.ssim=1.0')} runs: it has not finished")
    assert (first / "train" / "ours" / "best.safetensors").stat().st_mtime_ns == kept
    assert all(line.endswith(" is finished already") for line in sweep(project, *command))

    params = project / "params.yaml"
    params.write_text(params.read_text().replace("mse: 10.0", "mse: 12.0"))
    assert [line.partition(" runs: ")[2] for line in sweep(project, *command)] == [
        "values.loss.mse was 10.0, is 12.0"
    ] * 2


def test_a_point_with_other_values_of_the_sensor_makes_its_own_events_in_its_own_folder(project):
    before = (project / "data" / "events.zarr" / "zarr.json").read_bytes()
    sweep(project, "emulate.contrast_threshold_on=0.2,0.3", "hydra.sweep.dir=outputs/b", "hydra/launcher=joblib",
          "hydra.launcher.n_jobs=2")  # fmt: skip
    same, other = project / "outputs" / "b" / "0", project / "outputs" / "b" / "1"
    assert not (same / "events.zarr").exists()
    origin = json.loads((other / "events.zarr" / "origin.json").read_text())
    assert origin["values"]["emulate"]["contrast_threshold_on"] == 0.3
    assert not (other / "scenes.zarr").exists()  # the pipeline's serve
    assert (project / "data" / "events.zarr" / "zarr.json").read_bytes() == before
    scores = [json.loads((job / "benchmark" / "metrics.json").read_text()) for job in (same, other)]
    assert scores[0]["simulated"]["zeros"]["mse"] == scores[1]["simulated"]["zeros"]["mse"]
    assert scores[0]["simulated"]["ours"] != scores[1]["simulated"]["ours"]


def test_the_table_has_the_message_of_a_failed_point_not_hydras_advice(project):
    done = python(project, "trial", "-m", "train.learning_rate=0.001", "train.windows=500", "hydra.sweep.dir=outputs/c")
    assert done.returncode == 1
    assert "expected at most the" in (project / "outputs" / "c" / "0" / "failure.txt").read_text()
    assert "hydra.cc" not in (project / "outputs" / "c" / "0" / "failure.txt").read_text()
