"""dvc.yaml against what the stages really run and read: nothing is missing."""

import functools
import json
from pathlib import Path

import preloaded
import pytest
import tracer
from ruamel.yaml import YAML
from test_stages import TINY, save_time

from polarnet.config.origins import pipeline

PLUMBING = ("paths.", "runtime.", "cluster.")
"""Sections that change no result."""


def prepare(file: Path) -> None:
    save_time()
    tracer.record_to(file)


@pytest.mark.thorough
def test_a_stage_depends_on_all_code_that_it_runs_and_on_every_key_that_it_reads(project_root, tmp_path):
    """Every stage of the pipeline, run once at toy size."""
    missing = {}
    for name, stage in pipeline(project_root, YAML(typ="safe").load(project_root / "params.yaml")).items():
        arguments = [*TINY, f"paths.data={tmp_path / 'data'}", f"paths.resume={tmp_path / 'resume'}",
                     f"hydra.run.dir={tmp_path / 'logs' / name}", *stage.overrides]  # fmt: skip
        file = tmp_path / f"{name}.json"
        done = preloaded.run_stage(project_root, stage.script, arguments, functools.partial(prepare, file))
        assert done.returncode == 0, done.stdout
        used = json.loads(file.read_text())
        missing[name] = [
            *(one for one in used["files"] if not one.startswith(tracer.ENTRY) and not below(one, stage.deps)),
            *(
                key
                for key in used["keys"]
                if not key.startswith(PLUMBING)
                and key not in ("row", "baseline")
                and not any(f"{key}.".startswith(f"{one}.") for one in stage.params)
            ),
        ]
    assert {name: one for name, one in missing.items() if one} == {}


def below(path: str, deps: list[str]) -> bool:
    return any(Path(path).is_relative_to(dep) for dep in deps)
