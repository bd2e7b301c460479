"""Train every network on the same photographs, and score every method on held-out and on measured scenes.

python -m studies.study --photographs FOLDER --measured FOLDER --work FOLDER
    [--ours FILE] [--published ROW=FILE ...] [--override ROW:KEY=VALUE ...] [--only ROW]
    [--seed N] [--rows ROW ...] [--write]

The study runs the pipeline's stages with experiment=photographs in the folder --work. An interrupted run resumes, and
finished trainings are reused. To train networks side by side, start the command once for each with --only ROW, then
without. Choose `--override paper:train.epochs=N` so that both DoLP networks train for about the same time; the minutes
are printed.

--write updates docs/results/network.json with the scores of the two networks (section of the seed, and means over
seeds), and expected_errors.json with its picture. If every row was scored, it also updates benchmark.json,
event_budget.json and its picture. With --ours the section is `shipped` and does not enter the means. Further seeds
need only `--rows ours paper`, or `--rows ours` for the expected errors. No network is trained on measured scenes or on
the test split; the split is by source picture.
"""

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from statistics import fmean
from typing import Any

from polarnet.reports.figures import LIGHT
from polarnet.reports.maps import png
from studies.figures import expected_errors_figure
from studies.measure import (
    ABLATION_KEYS,
    arguments_of,
    command_line,
    machine_record,
    measure_benchmark,
    read_results,
    run_stage,
    write_section,
)
from studies.network_blocks import best_reconstruction, seeds_of

ROOT = Path(__file__).resolve().parents[1]
TRAININGS: dict[str, tuple[str, ...]] = {
    "ours": ("network=polarnet",),
    "paper": ("network=paper",),
    "firenet": ("baseline=e2v", "baselines.e2v.arch=firenet"),
    "e2vid": ("baseline=e2v", "baselines.e2v.arch=e2vid"),
    "e2p": ("baseline=e2p",),
}
"""Row of the table: overrides with which stage train trains its network."""
PUBLISHED = ("firenet_published", "cista_tc")
SOLVED = [f"{row}{gain}" for row in ("cf", "highpass", *PUBLISHED, "firenet") for gain in ("", "+gain")]
METHODS = ["zeros", "train_mean", "oracle_mean", *SOLVED, "e2vid", "e2p", "paper", "ours"]
BUDGET_SEQUENCES = 6
BUDGET_METHODS = ("oracle_mean", "highpass+gain", "ours")


def common(arguments: argparse.Namespace) -> list[str]:
    """Overrides that every command of this study gets: its data and its threads."""
    return [
        "experiment=photographs",
        f"ingest.root={arguments.photographs}",
        f"paths.data={arguments.work / 'data'}",
        f"runtime.threads={arguments.threads}",
    ]


def stage(name: str, arguments: argparse.Namespace, *overrides: str) -> None:
    """Run one stage of the pipeline on the data of this study."""
    run_stage(name, *common(arguments), *overrides)


def trained(row: str, arguments: argparse.Namespace) -> Path:
    """Folder of a row's training; its minutes.json holds the duration, null if a killed training was resumed."""
    choice = TRAININGS[row]
    root = arguments.work / f"train_{row}_{arguments.seed}"
    folder = root / next((one.removeprefix("baseline=") for one in choice if one.startswith("baseline=")), "ours")
    if not (folder / "minutes.json").exists():
        chosen = [pair for of_row, _, pair in (one.partition(":") for one in arguments.override) if of_row == row]
        resume = arguments.work / "resume" / root.name
        whole, started = not any(resume.glob("*/running.pt")), time.monotonic()
        paths = (f"paths.train={root}", f"paths.resume={resume}")
        stage("train", arguments, *choice, f"benchmark.methods=[{row}]", f"seed={arguments.seed}", *paths, *chosen)
        minutes = round((time.monotonic() - started) / 60, 1) if whole else None
        (folder / "minutes.json").write_text(json.dumps(minutes))
    return folder


def headlines(tables: dict[str, dict[str, dict[str, Any]]]) -> dict[str, Any]:
    """Comparisons of the two DoLP networks, from the tables."""
    simulated, measured = tables["simulated"], tables["measured"]
    best = measured[best_reconstruction(measured)]["mse"]
    return {
        "gain_over_paper_db": simulated["ours"]["psnr"] - simulated["paper"]["psnr"],
        "mse_over_paper": simulated["ours"]["mse"] / simulated["paper"]["mse"],
        "mse_over_oracle_mean": simulated["ours"]["mse"] / simulated["oracle_mean"]["mse"],
        "measured": {"mse_over_best_baseline": measured["ours"]["mse"] / best},
    }


COMPARISONS = ("gain_over_paper_db", "mse_over_paper", "mse_over_oracle_mean")


def over_seeds(seeds: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over the seeds of the comparisons of the two DoLP networks."""
    measured = fmean(seed["measured"]["mse_over_best_baseline"] for seed in seeds)
    means = {key: fmean(seed[key] for seed in seeds) for key in COMPARISONS}
    return means | {"measured": {"mse_over_best_baseline": measured}}


def parsed() -> argparse.Namespace:
    """The command line, with paths as every working directory understands them."""
    parser = command_line(__doc__, "docs/results")
    parser.add_argument("--photographs", type=Path, required=True)
    parser.add_argument("--measured", type=Path, required=True, help="scenes as ingest.source=polarization takes them")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--ours", type=Path, help="weights of `ours`, such as the shipped ones, instead of training it")
    parser.add_argument(
        "--published",
        action="append",
        default=[],
        metavar="ROW=FILE",
        help=f"published weights of {' or '.join(PUBLISHED)}; a row without them is left out",
    )
    parser.add_argument(
        "--override", action="append", default=[], metavar="ROW:KEY=VALUE", help="value for the training of one row"
    )
    parser.add_argument("--only", choices=tuple(TRAININGS), help="train this one and stop")
    parser.add_argument("--rows", nargs="+", choices=tuple(TRAININGS), default=[*TRAININGS], help="to train and score")
    parser.add_argument("--seed", type=int, default=1, help="seed of the trainings; all seeds share the data")
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    parser.add_argument("--workers", type=int, default=1, help="processes that share the benchmark's sequences")
    arguments = arguments_of(parser)
    if "ours" not in arguments.rows and not arguments.ours and not arguments.only:
        parser.error(f"--rows {' '.join(arguments.rows)}: expected ours among them, or --ours FILE")
    pairs = [given.split("=", 1) for given in arguments.published]
    if unknown := [pair for pair in pairs if len(pair) != 2 or pair[0] not in PUBLISHED]:
        parser.error(f"--published {'='.join(unknown[0])}: expected ROW=FILE with ROW one of {', '.join(PUBLISHED)}")
    arguments.published = {row: Path(file).resolve() for row, file in pairs}
    for name in ("photographs", "measured", "work", "ours"):
        if path := getattr(arguments, name):
            setattr(arguments, name, path.resolve())
    return arguments


def main() -> None:
    """Train, benchmark, print and perhaps write."""
    arguments = parsed()
    record = machine_record(ROOT)
    if not (arguments.work / "data" / "events.zarr").exists():
        for name in ("ingest", "synthesize", "emulate"):
            stage(name, arguments)
    stage("weights", arguments)  # those of the table may be others than when the data were made
    if arguments.only:
        trained(arguments.only, arguments)
        return
    folders = {row: trained(row, arguments) for row in arguments.rows if row != "ours" or not arguments.ours}
    sets = ("benchmark.sets=[simulated,measured]", f"sets.measured_root={arguments.measured}")
    stage("sets", arguments, *sets)
    section = "shipped" if arguments.ours else f"seed_{arguments.seed}"
    results = arguments.work / f"benchmark_{section}"
    best = {row: folder / "best.safetensors" for row, folder in folders.items()}
    if arguments.ours:
        best["ours"] = arguments.ours
    weights = [f"methods.{row}.weights={file}" for row, file in best.items()]
    weights += [f"methods.{row}.weights={file}" for row, file in arguments.published.items()]
    scored = [row for row in METHODS if row.removesuffix("+gain") not in set(TRAININGS) - set(arguments.rows)]
    methods = f"benchmark.methods=[{','.join(scored)}]"
    stage(
        "benchmark",
        arguments,
        *sets,
        methods,
        *weights,
        f"paths.benchmark={results}",
        f"runtime.workers={arguments.workers}",
    )
    folders_of = {"simulated": results, "measured": results / "sets" / "measured"}
    tables, details = (
        {name: json.loads((path / file).read_text()) for name, path in folders_of.items()}
        for file in ("metrics.json", "details.json")
    )
    contents: dict[str, Any] = {
        "minutes_trained": {row: json.loads((path / "minutes.json").read_text()) for row, path in folders.items()},
        "threads": arguments.threads,
        "overrides": arguments.override,
        "rows": {
            name: {row: {key: scores.get(key) for key in ABLATION_KEYS} for row, scores in table.items()}
            for name, table in tables.items()
        },
    }
    both = {"ours", "paper"} <= set(arguments.rows)
    if both:
        contents |= headlines(tables)
    print(json.dumps({key: value for key, value in contents.items() if key != "rows"}, indent=2))
    if not arguments.write:
        return
    if "ours" in arguments.rows and not arguments.ours:
        sets_of = {
            name: {"mse": tables[name]["ours"]["mse"], **about["reliability"]["ours"]}
            for name, about in details.items()
        }
        expected_errors(section, {"minutes_trained": contents["minutes_trained"]["ours"], "sets": sets_of}, record)
    if both:
        seeds = seeds_of(read_results(ROOT, "network") | {section: contents})
        print(
            write_section(ROOT, "network", section, contents, record, over_seeds([*seeds.values()]) if seeds else None)
        )
    if set(arguments.rows) == set(TRAININGS):
        print(measure_benchmark(ROOT, results, record))
        print(event_budget(arguments, best["ours"], record))


def expected_errors(section: str, found: dict[str, Any], record: dict[str, Any]) -> None:
    """Write a seed's section of docs/results/expected_errors.json, and the picture of all seeds."""
    print(write_section(ROOT, "expected_errors", section, found, record))
    seeds = seeds_of(read_results(ROOT, "expected_errors"))
    picture = ROOT / "docs" / "pictures" / "expected_errors.png"
    picture.write_bytes(png(expected_errors_figure(seeds, LIGHT)))


def event_budget(arguments: argparse.Namespace, weights: Path, record: dict[str, Any]) -> Path:
    """Write docs/results/event_budget.json and its figure."""
    out = arguments.work / "event_budget"
    asked = ["--event-budget", "--weights", weights, "--methods", ",".join(BUDGET_METHODS), "--out", out]
    polarnet = Path(sys.executable).with_name("polarnet")
    command = [polarnet, "benchmark", *asked, "--limit", str(BUDGET_SEQUENCES)]
    subprocess.run([*command, *common(arguments)], cwd=ROOT, check=True)
    shutil.copy(out / "event_budget.png", ROOT / "docs" / "pictures" / "event_budget.png")
    return write_section(ROOT, "event_budget", "budget", json.loads((out / "event_budget.json").read_text()), record)


if __name__ == "__main__":
    main()
