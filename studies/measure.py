"""Measurements behind the figures in README and docs, written to docs/results.

python -m studies.measure [pipeline | tests | benchmark | ablation | sweep] [--sweep FOLDER ...]
"""

import argparse
import importlib.metadata
import itertools
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from polarnet.config.sweep import SCORES, mean_scores, sweep_points
from polarnet.reports.figures import LIGHT
from polarnet.reports.maps import png
from polarnet.reports.provenance import git, processor
from polarnet.runtime.machine import bf16_units, usable_cores
from studies.figures import loss_sweep_figure

ROOT = Path(__file__).resolve().parents[1]
DEMO_METRICS = "data/benchmark/metrics.json"
VERSIONS_OF = ("torch", "numpy", "numba", "zarr", "dvc", "hydra-core")
STAGE_STARTS = re.compile(r"Running stage '([\w@+]+)'")  # printed by dvc repro


def machine_record(root: Path) -> dict[str, Any]:
    """Machine, versions and commit of a measurement: the keys common to all files in docs/results."""
    return {
        "machine": processor(),
        "bf16_units": bf16_units(torch.device("cpu")),
        "cores": usable_cores(),
        "load": round(os.getloadavg()[0], 2),
        "versions": {"python": platform.python_version()} | {n: importlib.metadata.version(n) for n in VERSIONS_OF},
        "commit": git(root, "rev-parse", "HEAD"),
    }


def uncommitted(root: Path, *allowed: str) -> str:
    """Changed files of the project at `root`, except measured files and `allowed` ones.

    The result is empty if a figure may name its commit.
    """
    but_for = [f":!{path}" for path in ("docs/results", "docs/pictures", *allowed)]
    return git(root, "status", "--porcelain", "--untracked-files=no", "--", ".", *but_for)


def command_line(about: str | None, written: str) -> argparse.ArgumentParser:
    """Parser of a study with the option `--write`; `arguments_of` parses with it."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help=f"write {written}; needs a committed tree")
    return parser


def arguments_of(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The command's arguments; `--write` with uncommitted changes ends the program."""
    arguments = parser.parse_args()
    if arguments.write and (changed := uncommitted(ROOT)):
        parser.error(f"--write: commit first, because the figures name a commit; changed:\n{changed}")
    return arguments


def run_stage(name: str, *overrides: str) -> None:
    """Run stage `name` of the pipeline with these overrides; CalledProcessError if it fails."""
    subprocess.run([sys.executable, "-m", f"stages.{name}", *overrides], cwd=ROOT, check=True)


STAGE_OUTPUTS = {
    "ingest": "images", "synthesize": "scenes.zarr", "emulate": "events.zarr", "train": "train/ours/best.safetensors",
}  # fmt: skip
"""Outputs of the stages of a training in its folder of data, in order."""


def run_missing(data: Path, *overrides: str, until: str = "train") -> Path:
    """Run the stages of a training up to `until` whose outputs `data` lacks; returns the path of the last output.

    A training that was cut off is resumed: its running checkpoint is deleted only at its end.
    """
    stages = list(STAGE_OUTPUTS)
    if until not in stages:
        raise ValueError(f"until: expected one of {', '.join(stages)}, got {until!r}")
    resume = data / "resume"
    for stage in stages[: stages.index(until) + 1]:
        cut_off = stage == "train" and any(resume.glob("*/running.pt"))
        if cut_off or not (data / STAGE_OUTPUTS[stage]).exists():
            run_stage(stage, f"paths.data={data}", f"paths.resume={resume}", *overrides)
    return data / STAGE_OUTPUTS[until]


def read_results(root: Path, name: str) -> dict[str, Any]:
    """Content of docs/results/NAME.json; empty if the file does not exist yet."""
    path = root / "docs" / "results" / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else {}


def write_section(
    root: Path,
    name: str,
    section: str,
    figures: Mapping[str, Any],
    record: Mapping[str, Any],
    headlines: Mapping[str, Any] | None = None,
) -> Path:
    """Write `figures` and the machine's record as one section of docs/results/NAME.json; other sections stay.

    The record (`machine_record`, taken before measuring) becomes `records.SECTION`, because sections may be measured
    on different days. `headlines` are figures above the sections; a mapping is merged into the existing one.
    """
    path, known = root / "docs" / "results" / f"{name}.json", read_results(root, name)
    known["records"] = dict(sorted({**known.get("records", {}), section: dict(record)}.items()))
    known[section] = dict(figures)
    for key, value in (headlines or {}).items():
        known[key] = {**known.get(key, {}), **value} if isinstance(value, Mapping) else value
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(dict(sorted(known.items())), indent=2, allow_nan=False) + "\n")
    return path


def measure_pipeline(root: Path) -> Path:
    """Clone HEAD of the project at `root`, time `make repro` and `make test` there; write docs/results/pipeline.json.

    The overview picture of the README, `dvc.lock` and `data/benchmark/metrics.json` come from the same run, so that
    `dvc metrics diff` has numbers to compare with in every clone. docs/results/speed.json gets the minutes too. If the
    tests fail, pipeline.json lacks only their minutes.

    Raises RuntimeError if a command fails or a second `make repro` runs a stage. Uncommitted changes raise it too,
    because the figures would not belong to the commit they name.
    """
    _refuse_changes(root)
    machine = machine_record(root)
    record = dict(machine)
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "polarnet"
        subprocess.run(["git", "clone", "--quiet", str(root), str(clone)], check=True)
        record["setup_minutes"], _ = _timed("setup", clone)
        record["repro_minutes"], record["stage_minutes"] = _timed("repro", clone)
        _, again = _timed("repro", clone)
        if again:
            raise RuntimeError(f"a second make repro ran {', '.join(again)}; everything should have been cached")
        minutes = {"repro_minutes": record["repro_minutes"]}
        write_section(root, "speed", "repro", minutes, machine, headlines=minutes)
        record["metrics"] = scores_and_costs(clone / "data" / "benchmark")
        details = json.loads((clone / "data" / "benchmark" / "details.json").read_text())
        record |= {key: details[key] for key in ("lpips", "weights")}
        shutil.copy(clone / "data" / "report" / "overview.png", root / "docs" / "pictures" / "overview.png")
        (root / DEMO_METRICS).parent.mkdir(parents=True, exist_ok=True)
        for name in ("dvc.lock", DEMO_METRICS):
            shutil.copy(clone / name, root / name)
        path = root / "docs" / "results" / "pipeline.json"
        path.write_text(json.dumps(record, indent=2) + "\n")  # keeps the measurements if a test fails
        record["test_minutes"], _ = _timed("test", clone)
    path.write_text(json.dumps(record, indent=2) + "\n")
    return path


def measure_tests(root: Path) -> Path:
    """Time `make test` in a fresh clone of HEAD; replace the minutes in docs/results/pipeline.json and name the commit.

    It completes a run of `measure_pipeline` whose tests failed, without timing `make repro` again. Raises RuntimeError
    if the tests fail or the tree has uncommitted changes.
    """
    _refuse_changes(root)
    record = read_results(root, "pipeline")
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "polarnet"
        subprocess.run(["git", "clone", "--quiet", str(root), str(clone)], check=True)
        _timed("setup", clone)
        minutes, _ = _timed("test", clone)
    path = root / "docs" / "results" / "pipeline.json"
    record |= {"test_minutes": minutes, "test_commit": git(root, "rev-parse", "HEAD")}
    path.write_text(json.dumps(record, indent=2) + "\n")
    return path


def _refuse_changes(root: Path) -> None:
    if git(root, "status", "--porcelain", "--untracked-files=no"):
        raise RuntimeError("the tree has uncommitted changes; commit them first, the figures name a commit")


BENCHMARK_KEYS = (
    "mse", "psnr", "ssim", "lpips", "lpips_backbone", "level_mse", "pattern_mse", "corr", "grad", "skill", "aolp_deg",
    "ms_per_window", "gflop", "params", "peak_mib",
)  # fmt: skip
"""Scores of each method in docs/results/benchmark.json; the intervals stay in metrics.json."""


def scores_and_costs(folder: Path) -> dict[str, dict[str, Any]]:
    """Scores and costs by row, from metrics.json and cost.json in the folder of a test set's results."""
    metrics, costs = (json.loads((folder / f"{name}.json").read_text()) for name in ("metrics", "cost"))
    return {row: {**scores, **costs[row]} for row, scores in metrics.items()}


def measure_benchmark(root: Path, benchmark: Path, record: Mapping[str, Any] | None = None) -> Path:
    """Write docs/results/benchmark.json from the results in the folder `benchmark`.

    `record` is the machine's record from before the run; None takes it now.

    The keys of the file are the test sets, then the methods, then `BENCHMARK_KEYS`. The file also has the machine's
    record and each set's comparisons of `ours` with the other methods. Raises RuntimeError if the simulated or the
    measured set was not run, or if the tree has uncommitted changes.
    """
    if uncommitted(root, "dvc.lock", "data", "params.yaml"):
        raise RuntimeError("the tree has uncommitted changes; commit them first, the figures name a commit")
    folders = {"simulated": benchmark} | {path.name: path for path in sorted(benchmark.glob("sets/*")) if path.is_dir()}
    missing = [name for name in ("simulated", "measured") if not (folders.get(name, root) / "metrics.json").exists()]
    if missing:
        raise RuntimeError(
            f"{benchmark} has no results of {' and '.join(missing)}; run `dvc repro` with "
            f"benchmark.sets=[simulated,measured] and sets.measured_root=FOLDER first"
        )
    section: dict[str, Any] = {**(record or machine_record(root)), "paired": {}, "about": {}}
    for name, folder in folders.items():
        metrics, details = scores_and_costs(folder), json.loads((folder / "details.json").read_text())
        section[name] = {method: {key: scores.get(key) for key in BENCHMARK_KEYS} for method, scores in metrics.items()}
        section["paired"][name] = details["paired"]
        section["about"][name] = {key: details[key] for key in ("frames", "warmup_windows", "precision")} | {
            "scenes": len(details["scenes"]),
            "lpips": details["lpips"],
        }
    path = root / "docs" / "results" / "benchmark.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(section, indent=2, allow_nan=False) + "\n")
    return path


ABLATION_KEYS = ("mse", "level_mse", "pattern_mse", "psnr", "ssim", "corr", "aolp_deg")
"""Scores of each ablation in docs/results/network.json."""


def measure_ablation(root: Path, sweep: Path) -> Path:
    """Write section `ablation` of docs/results/network.json from a sweep over the files of conf/ablation.

    Raises RuntimeError if a job has no
    `ablation=NAME`, if the baseline `ablation=nothing` is missing, if an ablation has two jobs, or if the tree has
    uncommitted changes. Failed jobs are left out.
    """
    if uncommitted(root):
        raise RuntimeError("the tree has uncommitted changes; commit them first, the figures name a commit")
    rows, overrides = {}, set()
    for point in sweep_points(sweep):
        if point["failure"]:
            continue
        given = dict(one.lstrip("+").split("=", 1) for one in point["overrides"])
        if "ablation" not in given:
            raise RuntimeError(f"{sweep / point['job']}: expected ablation=NAME among its overrides, got {given}")
        name = given.pop("ablation")
        if name in rows:
            raise RuntimeError(f"{sweep / point['job']}: expected one job with ablation={name}, got a second")
        rows[name] = {key: point["test"].get(key) for key in ABLATION_KEYS}
        overrides |= {f"{key}={value}" for key, value in given.items() if not key.startswith(("paths.", "ingest.root"))}
    if "nothing" not in rows:
        raise RuntimeError(f"{sweep}: expected a finished job with ablation=nothing, got {', '.join(rows) or 'no job'}")
    section = {"overrides": sorted(overrides), "rows": rows}
    return write_section(root, "network", "ablation", section, machine_record(root))


def ablation_about(root: Path, name: str) -> str:
    """The comment of conf/ablation/NAME.yaml: the part that the ablation removes or changes."""
    return (root / "conf" / "ablation" / f"{name}.yaml").read_text().splitlines()[1].removeprefix("# ")


EQ9_WEIGHTS = ("mse", "ssim", "lpips")


def measure_sweep(root: Path, sweeps: Sequence[Path]) -> list[Path]:
    """Write docs/results/sweep.json and docs/pictures/loss_sweep.png from sweeps over the weights of Eq. 9.

    `points` has the weights, the seeds, and the means and standard deviations over seeds of each combination, sorted by
    validation MSE with the smallest first. The sweeps may differ only in `loss.mse`, `loss.ssim`, `loss.lpips` and
    `seed`. Raises RuntimeError if other settings differ, if a job failed or none exists, or if the tree has uncommitted
    changes.
    """
    if uncommitted(root):
        raise RuntimeError("the tree has uncommitted changes; commit them first, the figures name a commit")
    varied = ("seed", *(f"loss.{name}" for name in EQ9_WEIGHTS))
    jobs: dict[tuple[float, ...], dict[int, dict[str, Any]]] = {}
    settings: set[tuple[str, ...]] = set()
    for folder in sweeps:
        for point in sweep_points(folder):
            if point["failure"]:
                raise RuntimeError(f"{folder / point['job']} failed: {point['failure']}; run this point again")
            overrides = [one for one in point["overrides"] if one.split("=", 1)[0] not in varied]
            settings.add(tuple(sorted(one for one in overrides if not one.startswith(("paths.", "runtime.")))))
            seeds = jobs.setdefault(tuple(float(point["weights"][name]) for name in EQ9_WEIGHTS), {})
            if point["seed"] in seeds:
                raise RuntimeError(
                    f"{folder / point['job']}: expected new weights or a new seed, got a second such job"
                )
            seeds[point["seed"]] = point
    if len(settings) != 1:
        listed = "; ".join(" ".join(one) or "none" for one in sorted(settings)) or "no job"
        raise RuntimeError(
            f"expected sweeps that differ in {', '.join(varied)} alone, got as other overrides: {listed}"
        )
    points: list[dict[str, Any]] = [
        {
            "weights": dict(zip(EQ9_WEIGHTS, weights, strict=True)),
            "seeds": sorted(seeds),
            **{split: mean_scores([one[split] for one in seeds.values()], names) for split, names in SCORES.items()},
            "notes": list(dict.fromkeys(note for one in seeds.values() for note in one["notes"])),
        }
        for weights, seeds in jobs.items()
    ]
    points.sort(key=lambda point: point["validation"]["mse"]["mean"])
    one_job = next(iter(next(iter(jobs.values())).values()))
    about = {"overrides": [*settings.pop()], "lpips_backbone": one_job["lpips_backbone"]}
    path = write_section(root, "sweep", "loss_weights", about, machine_record(root), {"points": points})
    picture = root / "docs" / "pictures" / "loss_sweep.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    picture.write_bytes(png(loss_sweep_figure(points, LIGHT)))
    return [path, picture]


def _timed(target: str, folder: Path) -> tuple[float, dict[str, float]]:
    """Run `make target`; return its minutes and those of each DVC stage that it ran."""
    started = time.monotonic()
    marks: list[tuple[str, float]] = []
    with subprocess.Popen(
        ["make", target], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            if match := STAGE_STARTS.search(line):
                marks.append((match[1], time.monotonic()))
    ended = time.monotonic()
    if process.returncode:
        raise RuntimeError(f"make {target} failed in a fresh clone; what it printed is above")
    spans = itertools.pairwise([*marks, ("", ended)])
    stages: dict[str, float] = {}
    for (name, start), (_, end) in spans:
        stage = name.partition("@")[0]  # all rows and all trained baselines together
        stages[stage] = round(stages.get(stage, 0) + (end - start) / 60, 2)
    return round((ended - started) / 60, 2), stages


def main() -> None:
    """Measure one thing of this clone and write its figures."""
    parser = argparse.ArgumentParser(prog="python -m studies.measure", description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "what", nargs="?", choices=("pipeline", "tests", "benchmark", "ablation", "sweep"), default="pipeline",
        help="pipeline: time the README's two commands in a fresh clone of HEAD; tests: `make test` alone; "
        "benchmark: what data/benchmark holds; "
        "ablation: what a sweep over conf/ablation has left; sweep: the same of sweeps over the weights of the loss",
    )  # fmt: skip
    parser.add_argument(
        "--sweep", type=Path, nargs="+", default=[], metavar="FOLDER",
        help="below outputs/sweeps: one for ablation, one or more for sweep",
    )  # fmt: skip
    options = parser.parse_args()
    if options.what in ("ablation", "sweep") and not options.sweep:
        parser.error(f"{options.what}: say --sweep FOLDER, the one that the sweep named at its end")
    if options.what == "ablation" and len(options.sweep) > 1:
        parser.error(f"ablation: expected one --sweep FOLDER, got {len(options.sweep)}")
    if options.what == "ablation":
        path = measure_ablation(ROOT, options.sweep[0])
    elif options.what == "sweep":
        path, picture = measure_sweep(ROOT, options.sweep)
        print(f"wrote {picture}")
    elif options.what == "tests":
        path = measure_tests(ROOT)
    elif options.what == "benchmark":
        path = measure_benchmark(ROOT, ROOT / "data" / "benchmark")
    else:
        path = measure_pipeline(ROOT)
    print(f"wrote {path}; `python -m studies.docs` brings it into the README")


if __name__ == "__main__":
    main()
