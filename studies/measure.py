"""Figures of the pipeline, and the pictures of docs: python -m studies.measure

    [--pipeline] [--run NAME DATA] [--pictures]

--pipeline times the demo in a fresh clone (docs/results/pipeline.json). --run reads the simulated test set of a run of
the pipeline in the folder DATA: `paper` of experiment=paper_small, `benchmark` of experiment=photographs with the rows
of the table. --pictures draws those that show nothing but the simulation, the shipped weights and the demo. The tree
must be committed, because figures name a commit. Every other study is a command of its own.
"""

import argparse
import itertools
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image

from studies.study import (
    PICTURES,
    ROOT,
    arguments_of,
    machine_record,
    scores_and_costs,
    uncommitted,
    write_section,
)

DEMO_METRICS = "data/benchmark/metrics.json"
STAGE_STARTS = re.compile(r"Running stage '([\w@+]+)'")  # printed by dvc repro
RUNS = {"paper": "paper_small", "benchmark": "simulated"}
"""Section of docs/results/NAME.json that a finished run fills, by NAME."""
PICTURE_MODULES = ("overview", "simulation_pictures", "physics_pictures")


def measure_pipeline(root: Path = ROOT) -> Path:
    """Clone HEAD of the project at `root`, time its set-up, `make repro` and `make test`; write pipeline.json.

    `dvc.lock` and the demo's metrics come from the same run. RuntimeError if a command fails, a
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


def measure_run(name: str, data: Path, root: Path = ROOT) -> Path:
    """Write docs/results/NAME.json from the simulated test set of a finished run in the folder `data`."""
    folder = data / "benchmark" / "sets" / "simulated"
    details = json.loads((folder / "details.json").read_text(encoding="utf-8"))
    figures = {
        "scenes": len(details["scenes"]),
        "frames": details["frames"],
        "rows": scores_and_costs(folder),
        "paired": {row: one["mse"] for row, one in details["paired"].items()},
    }
    return write_section(name, RUNS[name], figures, machine_record(root), root=root)


def draw_pictures() -> None:
    """Draw the pictures that show nothing but the simulation and the demo."""
    for module in PICTURE_MODULES:
        subprocess.run([sys.executable, "-m", f"studies.{module}"], cwd=ROOT, check=True)
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "polarnet.cli", "demo", "--out", folder], cwd=ROOT, check=True)
        for name, file in (("simulate", "simulated/preview.png"), ("recover", "recovered/recovered.png")):
            with Image.open(Path(folder, file)) as picture:
                picture.convert("RGB").quantize().save(PICTURES / f"{name}.png", optimize=True)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.set_defaults(write=True)
    parser.add_argument("--pipeline", action="store_true")
    parser.add_argument("--pictures", action="store_true")
    parser.add_argument("--run", nargs=2, metavar=("NAME", "DATA"))
    arguments = arguments_of(parser)
    if arguments.run:
        measure_run(arguments.run[0], Path(arguments.run[1]))
    if arguments.pipeline:
        measure_pipeline()
    if arguments.pictures:
        draw_pictures()


if __name__ == "__main__":
    main()
