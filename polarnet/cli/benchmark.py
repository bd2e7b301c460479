"""Command that scores methods: on your own scenes, and in the studies of the pipeline's test sequences."""

import argparse
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

from polarnet.cli.outputs import MARKER, WORK, run_folder
from polarnet.cli.parsers import Commands
from polarnet.cli.project import project_root, settings_root, working_folder

if TYPE_CHECKING:
    from polarnet.config.tree import Config


def add_to(commands: Commands) -> None:
    """Its commands."""
    benchmark = commands.add_parser(
        "benchmark",
        help="every method on your own photographs or measured scenes; the event budget; the sensitivity",
        description="--scenes makes event sequences of a folder, runs every method that has its weights, prints the "
        "table and writes it with a page; nothing is trained. The other two study the pipeline's own test sequences. "
        "Sizes, motion and sensor are those of params.yaml.",
    )
    asked = benchmark.add_mutually_exclusive_group(required=True)
    asked.add_argument("--scenes", type=Path, metavar="FOLDER", help="photographs or measurements, in all subfolders")
    asked.add_argument("--event-budget", action="store_true", help="quality against events per pixel (paper, Fig. 11)")
    asked.add_argument("--sensitivity", action="store_true", help="quality against mismatch, noise, speed, channels")
    benchmark.add_argument(
        "--weights", type=Path, metavar="FILE", help="of the network; default: shipped; studies: trained here"
    )
    benchmark.add_argument(
        "--kind", choices=("auto", "photographs", "polarization"), default="auto",
        help="what lies in FOLDER; auto takes .npz files and NAME_0, NAME_45, ... for measured polarization",
    )  # fmt: skip
    benchmark.add_argument("--out", type=Path, metavar="DIR", help="default: below outputs/benchmark")
    benchmark.add_argument("--methods", help="separated by commas; default: benchmark.methods, or what a study studies")
    benchmark.add_argument("--limit", type=int, metavar="N", help="of the two studies: the first N test sequences")
    benchmark.add_argument("overrides", nargs="*", help="of params.yaml, as Hydra takes them: seed=2")
    benchmark.set_defaults(run=_benchmark)


def _benchmark(options: argparse.Namespace) -> int:
    from polarnet.config.tree import check_keys, load
    from polarnet.runtime.machine import configure

    if options.scenes and options.limit is not None:
        raise ValueError("--limit is for --event-budget and --sensitivity; --scenes scores all that lies in its folder")
    settings = settings_root() if options.scenes else project_root()  # a study needs the pipeline's test sequences
    folder = working_folder()
    scenes = options.scenes.resolve() if options.scenes else None
    name = scenes.name if scenes else "event_budget" if options.event_budget else "sensitivity"
    out = (options.out or folder / "outputs" / "benchmark" / name).resolve()
    weights = options.weights.resolve() if options.weights else None
    with contextlib.chdir(folder):  # paths of conf/config.yaml are relative to it
        chosen = [f"benchmark.methods=[{options.methods}]"] if scenes and options.methods else []
        check_keys(settings, options.overrides)
        config = load(settings, [*options.overrides, *chosen])
        configure(config.runtime, config.seed)
        if scenes is None:
            return _study(options, config, out, weights)
        return _own_scenes(options, config, scenes, out, weights)


def _own_scenes(options: argparse.Namespace, config: "Config", scenes: Path, out: Path, weights: Path | None) -> int:
    from polarnet.cli.own_scenes import benchmark_folder
    from polarnet.reports.tables import as_plain, score_table

    command = f"polarnet benchmark --scenes {options.scenes}"
    with run_folder(out, "benchmark --scenes") as folder:
        metrics, notes = benchmark_folder(config, scenes, options.kind, folder, out / WORK, weights, command)
    print(as_plain(score_table(metrics)))
    for note in notes:
        print(note)
    print(f"the page: {out / 'index.html'}")
    return 0


def _study(options: argparse.Namespace, config: "Config", out: Path, weights: Path | None) -> int:
    from polarnet.cli.studies import STUDIED, run_event_budget, run_sensitivity

    run = run_event_budget if options.event_budget else run_sensitivity
    methods = options.methods.split(",") if options.methods else STUDIED
    with run_folder(out, f"benchmark {'--event-budget' if options.event_budget else '--sensitivity'}") as folder:
        run(config, folder, methods, options.limit, weights)
    print(f"written to {out}: {', '.join(sorted(path.name for path in out.iterdir() if path.name != MARKER))}")
    return 0
