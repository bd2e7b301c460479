"""How much data helps: networks trained on few and on many photographs, scored on photographs and on measured scenes.

python -m studies.data_curve --training FOLDER --photographs FOLDER --photographs-large FOLDER --measured FOLDER ...
    --work FOLDER [--sizes N ...] [--visits N] [--jobs N] [--write]

--training has the training photographs, as `studies.robustness --training` links them. Each size takes that many of
them, every set within the next larger one (`ingest.limit`), and trains with `experiment=shipped`, but fewer visits.
Small sets are visited more often, so that all networks train for about as long. `studies.robustness` scores the
networks on the test split of both sets of photographs and on the measured scenes. The sizes are trained in the order
given. Finished trainings in --work are reused, interrupted ones resumed. --write puts the curve into
docs/results/data_curve.json.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from polarnet.runtime.machine import usable_cores
from polarnet.storage.frames import FrameStore
from studies.measure import arguments_of, command_line, machine_record, run_missing, write_section

ROOT = Path(__file__).resolve().parents[1]
OVERRIDES = ("benchmark.lpips=false",)
"""Overrides of all trainings."""
CONDITIONS = ("photographs_large", "measured")
FIGURES = ("mse", "level_mse", "psnr", "corr", "mse_over_oracle_mean", "median_over_oracle_mean")


def trained(photographs: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """Train a network on a set; returns its checkpoint, and the numbers of sequences and of visits to each."""
    data = arguments.work / str(photographs)
    common = (
        "experiment=shipped", f"ingest.root={arguments.training}", f"ingest.limit={photographs}",
        f"runtime.threads={max(1, usable_cores() // arguments.jobs)}", "runtime.workers=1", *OVERRIDES,
    )  # fmt: skip
    run_missing(data, *common, until="emulate")
    sequences = len(FrameStore.open(data / "frames.zarr").of_split("train"))
    visits = max(1, round(arguments.visits / sequences))
    return {"weights": run_missing(data, *common, f"train.visits={visits}"), "sequences": sequences, "visits": visits}


def scored(networks: Mapping[str, Path], arguments: argparse.Namespace, conditions: Sequence[str]) -> dict[str, Any]:
    """The tables of `studies.robustness` for these networks, by condition."""
    work = arguments.work / "scores"
    measured = map(str, arguments.measured)
    command = [
        sys.executable, "-m", "studies.robustness", "--photographs", str(arguments.photographs),
        "--photographs-large", str(arguments.photographs_large), "--measured", *measured, "--work", str(work),
        "--weights", *(f"{name}={file}" for name, file in networks.items()), "--limit", str(arguments.limit),
        "--workers", str(usable_cores()), "--conditions", *conditions,
    ]  # fmt: skip
    subprocess.run(command, cwd=ROOT, check=True)
    return json.loads((work / "robustness_test.json").read_text())["tables"]


def with_folders(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add the folders of photographs, measured scenes and intermediate files, and --limit."""
    for name in ("--training", "--photographs", "--photographs-large", "--work"):
        parser.add_argument(name, type=Path, required=True)
    parser.add_argument("--measured", type=Path, nargs="+", required=True)
    parser.add_argument("--limit", type=int, default=24, help="scored pictures of each set")
    return parser


def resolved(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The command line, with paths as every working directory understands them."""
    arguments = arguments_of(parser)
    for name in ("training", "photographs", "photographs_large", "work"):
        setattr(arguments, name, getattr(arguments, name).resolve())
    arguments.measured = [folder.resolve() for folder in arguments.measured]
    return arguments


def main() -> None:
    """Train and score, print and perhaps write."""
    parser = with_folders(command_line(__doc__, "docs/results/data_curve.json"))
    parser.add_argument("--sizes", type=int, nargs="+", default=[574, 300, 100], help="photographs of each training")
    parser.add_argument("--visits", type=int, default=1066, help="visits of each training, about")
    parser.add_argument("--jobs", type=int, default=2, help="trainings at a time")
    arguments = resolved(parser)
    record = machine_record(ROOT)
    with ThreadPoolExecutor(arguments.jobs) as pool:
        trainings = list(pool.map(lambda size: trained(size, arguments), arguments.sizes))
    networks = {f"photographs_{size}": one["weights"] for size, one in zip(arguments.sizes, trainings, strict=True)}
    tables = scored(networks, arguments, CONDITIONS)
    rows = [
        {
            "photographs": size,
            "sequences": one["sequences"],
            "visits": one["visits"],
            **{name: {key: tables[name]["rows"][network][key] for key in FIGURES} for name in CONDITIONS},
        }
        for size, one, network in zip(arguments.sizes, trainings, networks, strict=True)
    ]
    scenes = {name: tables[name]["scenes"] for name in CONDITIONS}
    print(json.dumps(rows, indent=1))
    if arguments.write:
        curve = {"overrides": OVERRIDES, "scenes": scenes, "rows": sorted(rows, key=lambda row: row["photographs"])}
        print(write_section(ROOT, "data_curve", "curve", curve, record))


if __name__ == "__main__":
    main()
