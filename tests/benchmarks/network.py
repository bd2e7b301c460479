"""The network polarnet against the paper's, both trained on the same photographs for about as long, and the baselines.

python tests/benchmarks/network.py --photographs FOLDER --measured FOLDER --work FOLDER
    [--firenet FILE] [--write]

Runs the pipeline's stages with experiment=photographs in the folder --work, where a killed run goes on, and prints the
tables of held-out photographs and of measured scenes, on which nothing was trained. --write puts them into
docs/results/network.json. Choose --paper-epochs so that both trainings take about as long: the minutes are printed.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from polarnet.measure import BENCHMARK_KEYS, machine_record, uncommitted, write_section

ROOT = Path(__file__).resolve().parents[2]
INTENSITY = [f"{row}{gain}" for row in ("cf", "highpass", "firenet_published") for gain in ("", "+gain")]
METHODS = ["zeros", "train_mean", "oracle_mean", *INTENSITY, "paper", "ours"]


def stage(name: str, arguments: argparse.Namespace, *overrides: str) -> None:
    """Run one stage of the pipeline on the data of this study."""
    data = arguments.work / "data"
    common = [
        "experiment=photographs",
        f"ingest.root={arguments.photographs}",
        f"seed={arguments.seed}",
        f"paths.data={data}",
        f"paths.resume={arguments.work / 'resume'}",
        f"paths.cache={arguments.work / 'cache'}",
        f"runtime.threads={arguments.threads}",
    ]
    subprocess.run([sys.executable, "-m", f"stages.{name}", *common, *overrides], cwd=ROOT, check=True)


def trained(network: str, epochs: int, arguments: argparse.Namespace) -> Path:
    """The folder of a network's training, and in its minutes.json how long that took; null: a killed one went on."""
    folder = arguments.work / f"train_{network}_{epochs}"
    if not (folder / "minutes.json").exists():
        whole, started = not any((arguments.work / "resume").glob("*/running.pt")), time.monotonic()
        stage("train", arguments, f"network={network}", f"train.epochs={epochs}", f"paths.train={folder}")
        minutes = round((time.monotonic() - started) / 60, 1) if whole else None
        (folder / "minutes.json").write_text(json.dumps(minutes))
    return folder


def headlines(tables: dict[str, dict[str, dict[str, Any]]]) -> dict[str, Any]:
    """What the tables say of the two networks."""
    simulated, measured = tables["simulated"], tables["measured"]
    best = min(scores["mse"] for row, scores in measured.items() if row in INTENSITY)
    over_paper = {}
    if "paper" in simulated:
        over_paper = {
            "gain_over_paper_db": simulated["ours"]["psnr"] - simulated["paper"]["psnr"],
            "mse_over_paper": simulated["ours"]["mse"] / simulated["paper"]["mse"],
        }
    return over_paper | {
        "mse_over_oracle_mean": simulated["ours"]["mse"] / simulated["oracle_mean"]["mse"],
        "measured": {"mse_over_best_baseline": measured["ours"]["mse"] / best},
    }


def main() -> None:
    """Train both networks, benchmark them with the baselines, print and perhaps write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=Path, required=True)
    parser.add_argument("--measured", type=Path, required=True, help="scenes as ingest.source=polarization takes them")
    parser.add_argument("--firenet", type=Path, help="FireNet's published weights; without them its rows are left out")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--paper-epochs", type=int, default=1, help="0: leave the paper's network out")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    parser.add_argument("--write", action="store_true", help="write docs/results/network.json")
    arguments = parser.parse_args()
    if arguments.write and uncommitted(ROOT):
        parser.error("the tree has uncommitted changes; commit them first, the figures name a commit")
    arguments.photographs, arguments.measured, arguments.work = (
        path.resolve() for path in (arguments.photographs, arguments.measured, arguments.work)
    )
    record = machine_record(ROOT)
    if not (arguments.work / "data" / "events.zarr").exists():
        for name in ("ingest", "synthesize", "emulate", "weights"):
            stage(name, arguments)
    folders = {"ours": trained("polarnet", arguments.epochs, arguments)}
    if arguments.paper_epochs:
        folders["paper"] = trained("paper", arguments.paper_epochs, arguments)
    sets = ("benchmark.sets=[simulated,measured]", f"sets.measured_root={arguments.measured}")
    stage("sets", arguments, *sets)
    methods = f"benchmark.methods=[{','.join(METHODS)}]"
    weights = [f"paths.train={folders['ours']}"]
    if "paper" in folders:
        weights.append(f"baselines.weights.paper={folders['paper'] / 'best.safetensors'}")
    if arguments.firenet:
        weights.append(f"baselines.weights.firenet_published={arguments.firenet.resolve()}")
    stage("benchmark", arguments, *sets, methods, *weights)
    folder = arguments.work / "data" / "benchmark"
    tables, about = {}, {}
    for name, path in (("simulated", folder), ("measured", folder / "sets" / "measured")):
        rows, details = (json.loads((path / f"{file}.json").read_text()) for file in ("metrics", "details"))
        tables[name] = {row: {key: scores.get(key) for key in BENCHMARK_KEYS} for row, scores in rows.items()}
        about[name] = {"scenes": len(details["scenes"]), "frames": details["frames"], "paired": details["paired"]}
    minutes = {row: json.loads((path / "minutes.json").read_text()) for row, path in folders.items()}
    print(json.dumps({"minutes_trained": minutes} | headlines(tables), indent=2))
    if arguments.write:
        section = "study" if arguments.seed == 1 else f"study_seed_{arguments.seed}"
        found = {"minutes_trained": minutes, "threads": arguments.threads, "about": about, **tables}
        print(write_section(ROOT, "network", section, found, record, headlines(tables)))


if __name__ == "__main__":
    main()
