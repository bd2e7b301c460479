"""Figures of the pipeline, and the pictures of docs: python -m studies.measure

    [--pipeline] [--run NAME DATA] [--pictures]

--pipeline times the demo in a fresh clone (docs/results/pipeline.json). --run reads the simulated test set of a run of
the pipeline in the folder DATA: `paper` of experiment=paper_small, `benchmark` of experiment=photographs with the rows
of the table. --pictures draws those that show nothing but the simulation, the shipped weights and the demo. The tree
must be committed, because figures name a commit. Every other study is a command of its own.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import av
from PIL import Image

from studies.simulation_pictures import COLOURS
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
RUNS = {"paper": "paper_small", "benchmark": "simulated"}
"""Section of docs/results/NAME.json that a finished run fills, by NAME."""


def measure_pipeline(root: Path = ROOT) -> Path:
    """Clone HEAD of the project at `root`, time its set-up, `make repro` and `make test`; write pipeline.json.

    `dvc.lock` and the demo's metrics come from the same run. CalledProcessError if a command fails, RuntimeError if the
    tree has uncommitted changes.
    """
    if uncommitted(root):
        raise RuntimeError("the tree has uncommitted changes; commit them first, the figures name a commit")
    machine = machine_record(root)
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "polarnet"
        subprocess.run(["git", "clone", "--quiet", str(root), str(clone)], check=True)
        figures: dict[str, Any] = {f"{target}_minutes": minutes_of(target, clone) for target in ("setup", "repro")}
        figures["metrics"] = scores_and_costs(clone / "data" / "benchmark" / "sets" / "simulated")
        (root / DEMO_METRICS).parent.mkdir(parents=True, exist_ok=True)
        for name in ("dvc.lock", DEMO_METRICS):
            shutil.copy(clone / name, root / name)
        figures["test_minutes"] = minutes_of("test", clone)
    return write_section("pipeline", "demo", figures, machine, root=root)


def minutes_of(target: str, folder: Path) -> float:
    """Run `make target`, and return its minutes; CalledProcessError if it fails."""
    started = time.monotonic()
    subprocess.run(["make", target], cwd=folder, check=True)
    return round((time.monotonic() - started) / 60, 2)


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
    for module in ("overview", "simulation_pictures", "physics_pictures"):
        subprocess.run([sys.executable, "-m", f"studies.{module}"], cwd=ROOT, check=True)
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "polarnet.cli", "demo", "--out", folder], cwd=ROOT, check=True)
        with Image.open(Path(folder, "simulated", "preview.png")) as preview:
            pictures = {"simulate": preview.convert("RGB")}
        with av.open(str(Path(folder, "recovered", "recovered.mp4"))) as video:
            *_, last = video.decode(video=0)
        pictures["recover"] = last.to_image()
        for name, picture in pictures.items():
            picture.quantize(COLOURS).save(PICTURES / f"{name}.png", optimize=True)


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
