"""dvc.yaml against what the stages really run and read: nothing is missing, and docs/pipeline.md says what re-runs."""

import functools
import json
from pathlib import Path
from typing import NamedTuple

import preloaded
import pytest
import tracer
from ruamel.yaml import YAML
from test_stages import TINY, save_time

from polarnet.config.origins import Stage, pipeline

ENTRY = ("polarnet/config/tree.py", "polarnet/config/origins.py", "polarnet/terminal/")
"""What starts a stage, and what only says or draws: neither decides an output."""


class Trace(NamedTuple):
    """What one stage ran and read."""

    files: set[str]
    keys: set[str]


@pytest.fixture(scope="module")
def stages(project_root: Path) -> dict[str, Stage]:
    return pipeline(project_root, YAML(typ="safe").load(project_root / "params.yaml"))


@pytest.fixture(scope="module")
def traces(project_root: Path, stages: dict[str, Stage], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Trace]:
    """Every stage of the pipeline, run once at toy size."""
    folder = tmp_path_factory.mktemp("traces")
    found = {}
    for name, stage in stages.items():
        arguments = [*TINY, f"paths.data={folder / 'data'}", f"paths.resume={folder / 'resume'}",
                     f"hydra.run.dir={folder / 'logs' / name}", *stage.overrides]  # fmt: skip
        file = folder / f"{name}.json"
        done = preloaded.run_stage(project_root, stage.script, arguments, functools.partial(prepare, file))
        assert done.returncode == 0, done.stdout
        content = json.loads(file.read_text())
        found[name] = Trace(set(content["files"]), set(content["keys"]))
    return found


def prepare(file: Path) -> None:
    save_time()
    tracer.record_to(file)


def covered(path: str, deps: list[str]) -> bool:
    return any(Path(path).is_relative_to(dep) for dep in deps)


def missing(trace: Trace, stage: Stage) -> tuple[set[str], set[str]]:
    """Files and keys that a stage uses and dvc.yaml does not name."""
    files = {file for file in trace.files if not file.startswith(ENTRY) and not covered(file, stage.deps)}
    plumbing = ("paths.", "runtime.", "cluster.")
    keys = {key for key in trace.keys if not key.startswith(plumbing) and key not in ("row", "baseline")}
    return files, {key for key in keys if not any(key == one or key.startswith(f"{one}.") for one in stage.params)}


def test_a_stage_depends_on_all_code_that_it_runs_and_on_every_key_that_it_reads(traces, stages):
    found = {name: missing(traces[name], stage) for name, stage in stages.items()}
    assert {name: one for name, one in found.items() if any(one)} == {}
