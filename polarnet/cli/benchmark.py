"""Command that scores methods on your own scenes or recordings, or studies the pipeline's event budget."""

import argparse
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

from polarnet.cli.outputs import MARKER, WORK, run_folder
from polarnet.cli.parsers import Commands, add_cleaning, cleaning_of
from polarnet.cli.project import project_root, settings_root, working_folder

if TYPE_CHECKING:
    from polarnet.config.tree import Config
    from polarnet.recordings.noise import Cleaning

DESCRIPTION = """\
--scenes simulates event sequences from the pictures of a folder, runs every method whose weights are available,
prints the table and writes it with a page; it trains nothing. --recordings does the same on recordings of a camera
with a polarizer mosaic that hold frames. --event-budget studies the pipeline's own test sequences.
params.yaml sets sizes, motion and sensor."""

EXAMPLES = """\
examples:
  polarnet benchmark --scenes photographs/ --limit 10 --methods cf,highpass,ours
  polarnet benchmark --recordings pdavis/ --hot-pixels found
  polarnet benchmark --event-budget --limit 4"""

PDAVIS = "90 45 / 135 0"
PART = 2  # scenes


def add_to(commands: Commands) -> None:
    """Add the command benchmark."""
    benchmark = commands.add_parser(
        "benchmark",
        help="score every method on your own scenes or recordings, or study the event budget",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    asked = benchmark.add_mutually_exclusive_group(required=True)
    asked.add_argument(
        "--scenes", type=Path, metavar="FOLDER", help="photographs or measured polarization, subfolders included"
    )
    asked.add_argument(
        "--recordings",
        type=Path,
        metavar="FOLDER",
        help="recordings with frames: HDF5 of E2P, AEDAT-2 and AEDAT4 of a DAVIS, subfolders included",
    )
    asked.add_argument("--event-budget", action="store_true", help="quality against events per pixel (paper, Fig. 11)")
    benchmark.add_argument(
        "--weights",
        type=Path,
        metavar="FILE",
        help="checkpoint of the network (default: the shipped one; for studies the pipeline's)",
    )
    benchmark.add_argument(
        "--kind", choices=("auto", "photographs", "polarization"), default="auto",
        help="content of FOLDER; auto recognises .npz files and NAME_0, NAME_45, ... as measured polarization "
        "(default: auto)",
    )  # fmt: skip
    benchmark.add_argument(
        "--mosaic", metavar="'A B / C D'", help="polarizers of 2x2 pixels of --recordings (default: 90 45 / 135 0)"
    )
    add_cleaning(benchmark)
    benchmark.add_argument("--out", type=Path, metavar="FOLDER", help="output folder (default: outputs/benchmark/NAME)")
    benchmark.add_argument(
        "--methods", help="methods, separated by commas (default: benchmark.methods; studies have a list of their own)"
    )
    benchmark.add_argument(
        "--limit", type=int, metavar="N", help="use only N pictures of --scenes, or N test sequences"
    )
    benchmark.add_argument("overrides", nargs="*", help="values that replace those of params.yaml: seed=2")
    benchmark.set_defaults(run=_benchmark)


def _benchmark(options: argparse.Namespace) -> int:
    from polarnet.config.tree import load
    from polarnet.runtime.machine import configure, usable_cores

    own = options.scenes or options.recordings
    if options.recordings and options.limit is not None:
        raise ValueError("--limit does not apply to --recordings; leave it out")
    if options.limit is not None and options.limit < 1:
        raise ValueError(f"--limit: expected at least 1, got {options.limit}")
    if not options.recordings and (options.mosaic or options.hot_pixels or options.background):
        raise ValueError("--mosaic, --hot-pixels and --background apply to --recordings only; leave them out")
    settings = settings_root() if own else project_root()  # a study needs the pipeline's test sequences
    folder = working_folder()
    root = own.resolve() if own else None
    name = root.name if root else "event_budget"
    out = (options.out or folder / "outputs" / "benchmark" / name).resolve()
    weights = options.weights.resolve() if options.weights else None
    cleaning = cleaning_of(options)
    with contextlib.chdir(folder):  # paths of conf/config.yaml are relative to it
        chosen = [f"benchmark.methods=[{options.methods}]"] if own and options.methods else []
        # all cores, and small parts, which share few scenes evenly among them; an override replaces both
        shared = [f"runtime.workers={usable_cores()}", f"storage.sequences_per_part={PART}"] if own else []
        config = load(settings, [*shared, *options.overrides, *chosen], folder)
        configure(config.runtime, config.seed)
        if root is None:
            return _study(options, config, out, weights)
        return _own_folder(options, config, root, cleaning, out, weights)


def _own_folder(
    options: argparse.Namespace, config: "Config", root: Path, cleaning: "Cleaning", out: Path, weights: Path | None
) -> int:
    from polarnet.cli.own_scenes import Request, benchmark_folder, benchmark_recordings
    from polarnet.reports.artefacts import read_results, results_table
    from polarnet.reports.tables import as_plain
    from polarnet.stokes import parse_mosaic

    source = "--scenes" if options.scenes else "--recordings"
    command = f"polarnet benchmark {source} {options.scenes or options.recordings}"
    with run_folder(out, f"benchmark {source}") as folder:
        request = Request(root, folder, out / WORK, weights, command)
        if options.scenes:
            notes = benchmark_folder(config, request, options.kind, options.limit)
        else:
            notes = benchmark_recordings(config, request, parse_mosaic(options.mosaic or PDAVIS), cleaning)
    print(as_plain(results_table(read_results(out))))
    for note in notes:
        print(note)
    print(f"page: {out / 'index.html'}")
    return 0


def _study(options: argparse.Namespace, config: "Config", out: Path, weights: Path | None) -> int:
    from polarnet.cli.studies import STUDIED, run_event_budget

    methods = options.methods.split(",") if options.methods else STUDIED
    with run_folder(out, "benchmark --event-budget") as folder:
        run_event_budget(config, folder, methods, options.limit, weights)
    print(f"wrote to {out}: {', '.join(sorted(path.name for path in out.iterdir() if path.name != MARKER))}")
    return 0
