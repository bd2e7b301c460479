"""Commands of a clone of polarnet: its settings, its stages, the figures that its pages show."""

import argparse
import os
import subprocess
import sys
from pathlib import Path

from polarnet.cli.parsers import Commands


def add_to(commands: Commands) -> None:
    """Its commands."""
    doctor = commands.add_parser("doctor", help="what this machine offers: versions, device, bf16, weights, free disk")
    doctor.set_defaults(run=_doctor)

    preset = commands.add_parser("preset", help="write a named experiment or sensor into params.yaml, comments kept")
    preset.add_argument("name", help="a file of conf/experiment or conf/sensor: demo, smoke, paper, noisy, ...")
    preset.set_defaults(run=_preset)

    run = commands.add_parser("run", help="run all stages through Hydra alone, into outputs/run/NAME")
    run.add_argument("overrides", nargs="*", help="as Hydra takes them: experiment=smoke seed=2 paths.data=FOLDER")
    run.set_defaults(run=_run)

    stages = commands.add_parser("stages", help="the names of the stages, in order")
    stages.set_defaults(run=_stages)

    docs = commands.add_parser("docs", help="write docs/results/*.json into the tables of README.md and docs/")
    docs.add_argument("--check", action="store_true", help="change nothing; fail where a table is out of date")
    docs.set_defaults(run=_docs)

    measure = commands.add_parser("measure", help="write the figures that README and docs show")
    measure.add_argument(
        "what", nargs="?", choices=("pipeline", "benchmark", "ablation", "sweep"), default="pipeline",
        help="pipeline: time the README's two commands in a fresh clone of HEAD; benchmark: what data/benchmark holds; "
        "ablation: what a sweep over conf/ablation has left; sweep: the same of sweeps over the weights of the loss",
    )  # fmt: skip
    measure.add_argument(
        "--sweep", type=Path, nargs="+", default=[], metavar="FOLDER",
        help="below outputs/sweeps: one for ablation, one or more for sweep",
    )  # fmt: skip
    measure.set_defaults(run=_measure)


def project_root(start: Path | None = None) -> Path:
    """The nearest folder at or above `start` (default: here) that holds params.yaml and dvc.yaml."""
    start = (start or Path.cwd()).resolve()
    for folder in [start, *start.parents]:
        if (folder / "params.yaml").exists() and (folder / "dvc.yaml").exists():
            return folder
    raise FileNotFoundError(f"no params.yaml beside a dvc.yaml in {start} or above; run this inside a polarnet clone")


def _doctor(options: argparse.Namespace) -> int:
    from polarnet.doctor import findings

    for finding in findings():
        print(finding)
    return 0


def _preset(options: argparse.Namespace) -> int:
    from polarnet.experiments import group_of, write_preset

    root = project_root()
    changed = write_preset(root, options.name)
    print(f"params.yaml now holds {group_of(root, options.name)} {options.name}: {len(changed)} values changed")
    for line in changed:
        print(f"  {line}")
    return 0


def _run(options: argparse.Namespace) -> int:
    from polarnet.experiments import stage_names

    root = project_root()
    chosen = dict(item.split("=", 1) for item in options.overrides if "=" in item)
    name = "-".join([chosen.get("experiment", "demo"), *([chosen["sensor"]] if "sensor" in chosen else [])])
    folder = chosen.get("paths.data", f"outputs/run/{name}")
    overrides = [*options.overrides, *([] if "paths.data" in chosen else [f"paths.data={folder}"])]
    for stage in stage_names(root):
        print(f"== {stage}", flush=True)
        status = subprocess.run([sys.executable, "-m", f"stages.{stage}", *overrides], cwd=root).returncode
        if status:
            print(f"polarnet run: stage {stage} failed; what earlier stages made lies in {folder}", file=sys.stderr)
            return status
    print(f"done: {os.path.join(folder, 'report', 'index.html')}")
    return 0


def _stages(options: argparse.Namespace) -> int:
    from polarnet.experiments import stage_names

    print("\n".join(stage_names(project_root())))
    return 0


def _docs(options: argparse.Namespace) -> int:
    from polarnet.reports.readme import update_results_blocks

    changed = update_results_blocks(project_root(), check=options.check)
    for path in changed:
        print(f"{path}: {'out of date; run polarnet docs' if options.check else 'updated'}")
    return 1 if changed and options.check else 0


def _measure(options: argparse.Namespace) -> int:
    from polarnet.measure import measure_ablation, measure_benchmark, measure_pipeline, measure_sweep

    root = project_root()
    if options.what in ("ablation", "sweep") and not options.sweep:
        raise ValueError(f"measure {options.what}: say --sweep FOLDER, the one that the sweep named at its end")
    if options.what == "ablation":
        if len(options.sweep) > 1:
            raise ValueError(f"measure ablation: expected one --sweep FOLDER, got {len(options.sweep)}")
        path = measure_ablation(root, options.sweep[0])
    elif options.what == "sweep":
        path, picture = measure_sweep(root, options.sweep)
        print(f"wrote {picture}")
    elif options.what == "benchmark":
        path = measure_benchmark(root, root / "data" / "benchmark")
    else:
        path = measure_pipeline(root)
    print(f"wrote {path}; `polarnet docs` brings it into the README")
    return 0
