"""Commands for a clone of polarnet: its settings and its stages."""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from polarnet.cli.parsers import Commands
from polarnet.terminal.installation import shipped_settings

CODE = ("polarnet/", "stages/")
"""Dependencies of stages that are code."""


def add_to(commands: Commands) -> None:
    """Add the commands doctor, preset, run and stages."""
    doctor = commands.add_parser(
        "doctor",
        help="report versions, device, weights, extras, memory and disk",
        epilog="example: polarnet doctor --weights best.safetensors",
    )
    doctor.add_argument(
        "--weights", type=Path, metavar="FILE", help="check a file of weights, and name the rows that can use it"
    )
    doctor.set_defaults(run=_doctor)

    preset = commands.add_parser(
        "preset",
        help="write a named experiment or sensor into params.yaml, keeping comments",
        epilog="example: polarnet preset smoke",
    )
    preset.add_argument("name", help="name of a file in conf/experiment or conf/sensor: demo, smoke, paper, noisy, ...")
    preset.set_defaults(run=_preset)

    run = commands.add_parser(
        "run",
        help="run all stages through Hydra alone, into outputs/run/NAME",
        epilog="example: polarnet run experiment=smoke seed=2",
    )
    run.add_argument("overrides", nargs="*", help="overrides for Hydra: experiment=smoke seed=2 paths.data=FOLDER")
    run.set_defaults(run=_run)

    stages = commands.add_parser(
        "stages",
        help="list the stages in order, or those whose code or settings differ from dvc.lock",
        epilog="example: polarnet stages --unlocked",
    )
    stages.add_argument(
        "--unlocked",
        action="store_true",
        help="list the stages whose code or values differ from those in dvc.lock; exit status 1 if there are any",
    )
    stages.set_defaults(run=_stages)


def project_root() -> Path:
    """The nearest folder at or above the current one with params.yaml and dvc.yaml; FileNotFoundError if none has."""
    if clone := _clone():
        return clone
    raise FileNotFoundError(
        f"expected a clone of polarnet, found no params.yaml beside a dvc.yaml in {Path.cwd()} or above; "
        f"run this command inside a clone"
    )


def _clone() -> Path | None:
    here = Path.cwd().resolve()
    files = ("params.yaml", "dvc.yaml")
    return next((path for path in (here, *here.parents) if all((path / file).exists() for file in files)), None)


def settings_root() -> Path:
    """Folder of params.yaml and conf/: the clone at or above the current folder, else those beside the code."""
    return _clone() or shipped_settings()


def working_folder() -> Path:
    """Start of the paths of conf/config.yaml: the clone at or above the current folder, else the current folder."""
    return _clone() or Path.cwd()


def _doctor(options: argparse.Namespace) -> int:
    from polarnet.cli.doctor import findings, rows_for

    if options.weights is not None and not options.weights.is_file():
        raise FileNotFoundError(f"--weights {options.weights}: there is no such file")
    for finding in rows_for(options.weights) if options.weights else findings():
        print(finding)
    return 0


def _preset(options: argparse.Namespace) -> int:
    from polarnet.config.experiments import group_of, write_preset

    root = project_root()
    changed = write_preset(root, options.name)
    print(f"params.yaml now holds {group_of(root, options.name)} {options.name}: {len(changed)} values changed")
    for line in changed:
        print(f"  {line}")
    return 0


def _run(options: argparse.Namespace) -> int:
    from polarnet.config.experiments import BASE
    from polarnet.config.tree import load
    from polarnet.runtime.machine import end_with_parent

    root = project_root()
    chosen = dict(item.split("=", 1) for item in options.overrides if "=" in item)
    name = "-".join(chosen[group] for group in BASE if group in chosen) or BASE["experiment"]
    folder = chosen.get("paths.data", f"outputs/run/{name}")
    overrides = [*options.overrides, *([] if "paths.data" in chosen else [f"paths.data={folder}"])]
    for name, stage, own in hydra_runs(root, load(root, options.overrides).used_baselines):
        print(f"== {name}", flush=True)
        command = [sys.executable, "-m", f"stages.{stage}", *overrides, *own]
        status = subprocess.run(command, cwd=root, preexec_fn=end_with_parent).returncode
        if status:
            print(f"polarnet run: stage {name} failed; the results of earlier stages are in {folder}", file=sys.stderr)
            return status
    print(f"done: {os.path.join(folder, 'report', 'index.html')}")
    return 0


def hydra_runs(root: Path, baselines: list[str]) -> list[tuple[str, str, list[str]]]:
    """The pipeline without DVC, in order: name of a run, module in `stages`, and the overrides of this run alone.

    One pass runs all rows; `baselines` are those to train.
    """
    from polarnet.config.experiments import stage_names

    runs: list[tuple[str, str, list[str]]] = []
    for name in dict.fromkeys(stage.partition("@")[0] for stage in stage_names(root)):
        if name == "train_baseline":
            runs += [(f"{name}@{baseline}", "train", [f"baseline={baseline}"]) for baseline in baselines]
        else:
            runs.append((name, name, []))
    return runs


def _stages(options: argparse.Namespace) -> int:
    from polarnet.config.experiments import stage_names

    if not options.unlocked:
        print("\n".join(stage_names(project_root())))
        return 0
    command = [sys.executable, "-m", "dvc", "status", "--json"]
    status = subprocess.run(command, cwd=project_root(), capture_output=True, text=True)
    if status.returncode:
        raise RuntimeError(f"dvc status failed: {status.stderr.strip()}")
    changed = unlocked(json.loads(status.stdout))
    for stage, files in changed.items():
        print(f"{stage}: {', '.join(files)}")
    return 1 if changed else 0


def unlocked(status: Mapping[str, Any]) -> dict[str, list[str]]:
    """Code and settings of each stage that differ from dvc.lock, from `dvc status --json`; data do not count."""
    changed = {}
    for stage, changes in status.items():
        named = [change for change in changes if isinstance(change, dict)]
        deps = [item for change in named for item in change.get("changed deps", {}).items()]
        files = [path for path, how in deps if isinstance(how, dict) or (how == "modified" and path.startswith(CODE))]
        files += [change for change in changes if change == "changed command"]
        if files:
            changed[stage] = files
    return changed
