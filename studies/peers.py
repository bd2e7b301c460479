"""Train every network on the same photographs, and score every method on photographs that none of them saw.

python -m studies.peers --photographs FOLDER --work FOLDER
    [--ours FILE] [--published ROW=FILE ...] [--write]

The study runs the pipeline's stages with experiment=photographs in the folder --work. An interrupted run resumes, and
finished trainings are reused. The split is by source picture. --write puts the scores into docs/results/benchmark.json.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from polarnet.config.tables import collect_rows
from polarnet.config.tree import load
from studies.study import (
    ROOT,
    arguments_of,
    command_line,
    machine_record,
    row_of,
    run_stage,
    scores_and_costs,
    write_section,
)

TRAININGS: dict[str, tuple[str, ...]] = {
    "ours": ("network=polarnet",),
    "paper": ("network=paper",),
    "e2v": ("baseline=e2v",),
    "e2p": ("baseline=e2p",),
}
"""Row of the table: overrides with which stage train trains its network."""
PUBLISHED = ("firenet_published", "cista_tc")
SOLVED = [f"{row}{gain}" for row in ("cf", "highpass", *PUBLISHED, "e2v") for gain in ("", "+gain")]
METHODS = ["zeros", "train_mean", "oracle_mean", *SOLVED, "e2p", "paper", "ours"]


def common(arguments: argparse.Namespace) -> list[str]:
    """Overrides that every command of this study gets: its data and its threads."""
    return [
        "experiment=photographs",
        f"ingest.root={arguments.photographs}",
        f"paths.data={arguments.work / 'data'}",
        f"runtime.threads={arguments.threads}",
    ]


def trained(row: str, arguments: argparse.Namespace) -> Path:
    """Weights of a row, trained unless they are there; a training that was cut off is resumed."""
    root = arguments.work / f"train_{row}"
    weights = root / ("ours" if row == "paper" else row) / "best.safetensors"
    resume = arguments.work / "resume" / row
    if not weights.exists() or any(resume.glob("*/running.pt")):
        paths = (f"paths.train={root}", f"paths.resume={resume}", f"benchmark.methods=[{row}]")
        run_stage("train", *common(arguments), *TRAININGS[row], *paths)
    return weights


def benchmarked(arguments: argparse.Namespace, weights: dict[str, Path]) -> dict[str, Any]:
    """Scores and costs of every row, its comparison with `ours`, and numbers of scenes and frames."""
    results = arguments.work / "benchmark"
    simulated = results / "sets" / "simulated"
    overrides = [
        *common(arguments),
        f"benchmark.methods=[{','.join(METHODS)}]",
        *(row_of(row, file) for row, file in weights.items()),
        f"paths.benchmark={results}",
    ]
    for row in METHODS:
        run_stage("row", *overrides, f"row={row}")
    collect_rows(load(ROOT, overrides))
    details = json.loads((simulated / "details.json").read_text())
    return {
        "scenes": len(details["scenes"]),
        "frames": details["frames"],
        "rows": scores_and_costs(simulated),
        "paired": details["paired"],
    }


def main() -> None:
    """Train, benchmark, print and perhaps write."""
    parser = command_line(__doc__, "docs/results/benchmark.json")
    parser.add_argument("--photographs", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--ours", type=Path, help="weights of `ours`, such as the shipped ones, instead of training it")
    parser.add_argument("--published", nargs="+", default=[], metavar="ROW=FILE", help=f"of {', '.join(PUBLISHED)}")
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    arguments = arguments_of(parser)
    pairs = [given.partition("=") for given in arguments.published]
    arguments.published = {row: Path(file).resolve() for row, _, file in pairs if row in PUBLISHED}
    record = machine_record()
    if not (arguments.work / "data" / "events.zarr").exists():
        for name in ("ingest", "synthesize", "emulate"):
            run_stage(name, *common(arguments))
    run_stage("weights", *common(arguments))
    weights = {row: trained(row, arguments) for row in TRAININGS if row != "ours" or not arguments.ours}
    weights |= arguments.published | ({"ours": arguments.ours} if arguments.ours else {})
    figures = benchmarked(arguments, weights)
    print(json.dumps({row: one["mse"] for row, one in figures["rows"].items()}, indent=2))
    if arguments.write:
        write_section("benchmark", "simulated", figures, record)


if __name__ == "__main__":
    main()
