"""Measure everything behind the figures and pictures of README and docs: python -m studies.measure [NAME ...]

    [--photographs FOLDER] [--photographs-large FOLDER] [--measured FOLDER ...] [--published ROW=FILE ...]
    [--work FOLDER] [--sweep FOLDER] [--paper-small DATA]

Without names, every study of `STUDIES` runs, one after another; a study whose folders are not given is named and left
out. The command resumes: a study whose figures name the present commit already is not run again. Each study is also a
command of its own, `python -m studies.MODULE --help`. The tree must be committed, because figures name a commit.
"""

import argparse
import itertools
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from polarnet.config.sweep import sweep_points
from polarnet.reports.artefacts import git
from polarnet.reports.maps import png
from studies.overview import overview_figure, overview_of
from studies.study import (
    PICTURES,
    ROOT,
    arguments_of,
    machine_record,
    read_results,
    scores_and_costs,
    uncommitted,
    write_section,
)

DEMO_METRICS = "data/benchmark/metrics.json"
STAGE_STARTS = re.compile(r"Running stage '([\w@+]+)'")  # printed by dvc repro
SMALL_ROWS = ("train_mean", "oracle_mean", "cf", "e2v", "paper", "ours")
ABLATION_SCORES = ("mse", "level_mse", "pattern_mse", "psnr", "ssim", "corr", "aolp_deg")


class Study(NamedTuple):
    """A study that runs as a command of its own."""

    module: str
    file: str
    """NAME of docs/results/NAME.json that it writes."""
    section: str
    needs: tuple[str, ...] = ()
    """Options of this command that it cannot run without."""
    takes: tuple[str, ...] = ()
    """Further options of this command that it gets if they are given."""


STUDIES = {
    "simulation": Study("speed_of_simulation", "emulation", "models"),
    "recordings": Study("recordings", "recordings", "readers"),
    "network": Study("speed_of_network", "robustness", "speed"),
    "rig": Study("rig", "recordings", "rig"),
    "recorded": Study("recorded", "recorded", "simulated", takes=("published",)),
    "faults": Study("faults", "reliability", "artefacts"),
    "robustness": Study(
        "robustness", "robustness", "test", ("photographs", "measured", "work"), ("photographs_large", "published")
    ),
    "peers": Study("peers", "benchmark", "simulated", ("photographs", "work"), ("published",)),
}


def command_of(study: Study, given: Mapping[str, Any]) -> list[str]:
    """The command line of a study with the options that it takes."""
    command = [sys.executable, "-m", f"studies.{study.module}", "--write"]
    for name in (*study.needs, *study.takes):
        if value := given[name]:
            command += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, list) else [value])]
    return command


def finished(file: str, section: str, root: Path = ROOT) -> bool:
    """Whether the figures of a section of docs/results name the present commit."""
    record = read_results(root, file).get("records", {}).get(section, {})
    return record.get("commit") == git(root, "rev-parse", "HEAD")


def run_study(name: str, given: Mapping[str, Any]) -> None:
    """Run a study, unless it is finished or lacks a folder; CalledProcessError if it fails."""
    study = STUDIES[name]
    if missing := [need for need in study.needs if not given[need]]:
        print(f"{name}: left out, it needs {', '.join('--' + need.replace('_', '-') for need in missing)}")
    elif finished(study.file, study.section):
        print(f"{name}: measured at this commit already")
    else:
        print(f"{name}: {' '.join(command_of(study, given))}", flush=True)
        subprocess.run(command_of(study, given), cwd=ROOT, check=True)


def measure_pipeline(root: Path = ROOT) -> Path:
    """Clone HEAD of the project at `root`, time its set-up, `make repro` and `make test`; write pipeline.json.

    The README's overview, `dvc.lock` and the demo's metrics come from the same run. RuntimeError if a command fails, a
    second `make repro` runs a stage, or the tree has uncommitted changes.
    """
    if uncommitted(root):
        raise RuntimeError("the tree has uncommitted changes; commit them first, the figures name a commit")
    machine = machine_record(root)
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "polarnet"
        subprocess.run(["git", "clone", "--quiet", str(root), str(clone)], check=True)
        figures: dict[str, Any] = {"setup_minutes": timed_make("setup", clone)[0]}
        figures["repro_minutes"], figures["stage_minutes"] = timed_make("repro", clone)
        _, again = timed_make("repro", clone)
        if again:
            raise RuntimeError(f"a second make repro ran {', '.join(again)}; everything should have been cached")
        figures["metrics"] = scores_and_costs(clone / "data" / "benchmark" / "sets" / "simulated")
        picture = png(overview_figure(overview_of(clone / "data")))
        (root / "docs" / "pictures" / "overview.png").write_bytes(picture)
        (root / DEMO_METRICS).parent.mkdir(parents=True, exist_ok=True)
        for name in ("dvc.lock", DEMO_METRICS):
            shutil.copy(clone / name, root / name)
        figures["test_minutes"], _ = timed_make("test", clone)
    return write_section("pipeline", "demo", figures, machine, root=root)


def timed_make(target: str, folder: Path) -> tuple[float, dict[str, float]]:
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
    stages: dict[str, float] = {}
    for (name, start), (_, end) in itertools.pairwise([*marks, ("", ended)]):
        stage = name.partition("@")[0]  # all rows and all trained baselines together
        stages[stage] = round(stages.get(stage, 0) + (end - start) / 60, 2)
    return round((ended - started) / 60, 2), stages


def measure_ablation(sweep: Path, root: Path = ROOT) -> Path:
    """Write section `ablation` of docs/results/network.json from a sweep over conf/ablation, without failed jobs.

    RuntimeError if a job has no `ablation=NAME`, or if the reference `ablation=nothing` is missing.
    """
    rows: dict[str, dict[str, Any]] = {}
    for point in sweep_points(sweep):
        given = dict(one.lstrip("+").split("=", 1) for one in point["overrides"])
        if "ablation" not in given:
            raise RuntimeError(f"{sweep / point['job']}: expected ablation=NAME among its overrides, got {given}")
        if not point["failure"]:
            comment = (root / "conf" / "ablation" / f"{given['ablation']}.yaml").read_text().splitlines()[1]
            scores = {key: point["test"].get(key) for key in ABLATION_SCORES}
            rows[given["ablation"]] = {"about": comment.removeprefix("# "), **scores}
    if "nothing" not in rows:
        raise RuntimeError(f"{sweep}: expected a finished job with ablation=nothing, got {', '.join(rows) or 'no job'}")
    order = sorted(rows, key=lambda name: (name != "nothing", -rows[name]["mse"]))
    figures = {"rows": {name: rows[name] for name in order}}
    return write_section("network", "ablation", figures, machine_record(root), root=root)


def measure_paper_small(data: Path, root: Path = ROOT) -> Path:
    """Write docs/results/paper.json from a finished run of experiment=paper_small in the folder `data`.

    ValueError names the rows that the run lacks.
    """
    scores = scores_and_costs(data / "benchmark" / "sets" / "simulated")
    if missing := [row for row in SMALL_ROWS if row not in scores]:
        raise ValueError(f"{data}: expected the rows {', '.join(SMALL_ROWS)}; {', '.join(missing)} missing")
    return write_section("paper", "paper_small", {row: scores[row] for row in SMALL_ROWS}, machine_record(root))


def draw_pictures() -> None:
    """Draw the pictures that show nothing but the simulation and the demo."""
    for module in ("simulation_pictures", "physics_pictures"):
        subprocess.run([sys.executable, "-m", f"studies.{module}"], cwd=ROOT, check=True)
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "polarnet.cli", "demo", "--out", folder], cwd=ROOT, check=True)
        for name, file in (("simulate", "simulated/preview.png"), ("recover", "recovered/recovered.png")):
            with Image.open(Path(folder, file)) as picture:
                picture.convert("RGB").quantize().save(PICTURES / f"{name}.png", optimize=True)


def main() -> None:
    """Run the chosen studies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.set_defaults(write=True)
    names = ["pipeline", *STUDIES, "pictures"]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(names)}; default: all")
    parser.add_argument("--photographs", type=Path, help="folder of photographs")
    parser.add_argument("--photographs-large", type=Path, help="folder of further photographs")
    parser.add_argument("--measured", type=Path, nargs="+", default=[], help="as ingest.source=polarization takes them")
    parser.add_argument("--published", nargs="+", default=[], metavar="ROW=FILE", help="published weights of rows")
    parser.add_argument("--work", type=Path, help="folder for trainings and scenes; finished work in it is reused")
    parser.add_argument("--sweep", type=Path, help="only read a finished sweep over conf/ablation")
    parser.add_argument("--paper-small", type=Path, metavar="DATA", help="only read a run of experiment=paper_small")
    arguments = arguments_of(parser)
    if unknown := set(arguments.names) - set(names):
        parser.error(f"expected names of {', '.join(names)}; got {', '.join(sorted(unknown))}")
    if arguments.sweep:
        measure_ablation(arguments.sweep)
    if arguments.paper_small:
        measure_paper_small(arguments.paper_small)
    only_read = arguments.sweep or arguments.paper_small
    for name in arguments.names or ([] if only_read else names):
        if name == "pictures":
            draw_pictures()
        elif name != "pipeline":
            run_study(name, vars(arguments))
        elif not finished("pipeline", "demo"):
            measure_pipeline()


if __name__ == "__main__":
    main()
