"""`polarnet benchmark`: methods on a folder of your own, without training.

Scenes and events of a user's folder stay in `work` of the output: a second run only runs the methods.
"""

import argparse
import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from polarnet.benchmark.results import write_benchmark
from polarnet.benchmark.rows import available, weights_used
from polarnet.benchmark.run import run_benchmark
from polarnet.cli.options import CLEANING, cleaning_of, refuse
from polarnet.cli.outputs import WORK, run_folder
from polarnet.cli.project import settings_root, working_folder
from polarnet.cli.recorded import make_recorded_set
from polarnet.config.pipeline import context_of, lpips_of, made_set, train_mean_of
from polarnet.config.tree import Config, load
from polarnet.methods import is_rotating
from polarnet.metrics.lpips import record_of
from polarnet.networks.weights import shipped_weights
from polarnet.pictures.manifest import read_manifest
from polarnet.recordings.noise import Cleaning
from polarnet.reports.artefacts import read_results
from polarnet.reports.page import write_set_page
from polarnet.reports.tables import as_plain
from polarnet.runtime.machine import configure, on_one_thread, usable_cores
from polarnet.simulation.sets import emulate_scenes, make_folder_set
from polarnet.simulation.truth import motions_of
from polarnet.stokes import parse_mosaic
from polarnet.storage.scenes import SceneStore

PDAVIS = "90 45 / 135 0"
PART = 2  # scenes
NOT_ROTATING = "recordings hold the events of four channels, not those behind a rotating polarizer"
RECORDED_SENTENCE = "Windows lie between the recordings' frames, whose polarization is the truth."


def run(options: argparse.Namespace) -> None:
    """Score methods on a folder and print the table."""
    refuse(options, *(("--recordings", ["limit"]) if options.recordings else ("--scenes", ["mosaic", *CLEANING])))
    if options.limit is not None and options.limit < 1:
        raise ValueError(f"--limit: expected at least 1, got {options.limit}")
    root, folder, cleaning = (options.scenes or options.recordings).resolve(), working_folder(), cleaning_of(options)
    options.out = (options.out or folder / "outputs" / "benchmark" / root.name).resolve()
    options.weights = options.weights and options.weights.resolve()
    # all cores, and small parts, which share few scenes evenly among them; an override replaces both
    shared = [f"runtime.workers={usable_cores()}", f"storage.sequences_per_part={PART}"]
    chosen = [f"benchmark.methods=[{options.methods}]"] if options.methods else []
    with contextlib.chdir(folder):  # paths of conf/config.yaml are relative to it
        config = load(settings_root(), [*shared, *options.overrides, *chosen], folder)
        configure(config.runtime, config.seed)
        notes = _score_folder(options, config, root, cleaning)
    print(as_plain(read_results(options.out).table), *notes, sep="\n")
    print(f"page: {options.out / 'index.html'}")


def _score_folder(options: argparse.Namespace, config: Config, root: Path, cleaning: Cleaning) -> list[str]:
    """Run the benchmark on a folder, write scores and page, and return the notes on files and methods left out."""
    source = "--scenes" if options.scenes else "--recordings"
    without_lpips: list[str] = []
    try:
        lpips = lpips_of(config)
    except ValueError as error:
        lpips = None
        without_lpips.append(f"LPIPS was left out: {error}.")
    wanted = list(dict.fromkeys([*config.benchmark.methods, *(["ours"] if options.weights else [])]))
    mean = train_mean_of(config) if Path(config.paths.frames).exists() else None  # None: no training split was made
    context = context_of(config, wanted, mean, options.weights or shipped_weights())
    methods, left_out = available(wanted, context)
    if options.recordings:
        left_out |= {row: NOT_ROTATING for row in methods if is_rotating(row)}
        methods = [row for row in methods if row not in left_out]
    settings = dataclasses.replace(config.benchmark, methods=methods, lpips=lpips is not None)
    work = options.out / WORK / "set"
    with run_folder(options.out, f"benchmark {source}") as folder:
        if options.scenes:
            used = {name: dataclasses.asdict(getattr(config, name)) for name in ("synthesize", "emulate")}
            about = _sequences_in_words(config)
            print(about, "simulating the scenes; the first run also compiles the simulation", sep="\n", flush=True)
            notes = _make_scenes(options, config, root, work)
        else:
            used, about = {}, RECORDED_SENTENCE
            notes = make_recorded_set(root, work, parse_mosaic(options.mosaic or PDAVIS), cleaning)
        notes += [*without_lpips, *(f"{row} was left out: {reason}." for row, reason in left_out.items())]
        rotating = None
        if any(map(is_rotating, methods)):
            rotating, mapper = work.with_name("rotating.zarr"), config.mapper("emulate_rotating")
            emulate_scenes(work / "scenes.zarr", rotating, config.camera, config.seed, mapper, 1, config.rotating)
        test_set = made_set(root.name, work, rotating)
        mapper = config.mapper("benchmark")

        def mapped(task: Callable[[str], Any], names: Sequence[str]) -> list[Any]:
            return mapper(functools.partial(on_one_thread, task), names)

        benchmark = run_benchmark(test_set, context, settings, lpips, mapped)
        details = {
            "set": test_set.name,
            "lpips": record_of(lpips.backbone if lpips else None),
            "train_mean": context.train_mean,
            "weights": weights_used(methods, context),
            "conditions": {"sentence": about, **used},
            "left_out": notes,
        }
        write_benchmark(folder, benchmark, settings, config.seed, details)
        write_set_page(folder, test_set.name, options.command_line, notes)
    return notes


def _sequences_in_words(config: Config) -> str:
    motion = config.synthesize
    size = f"{motion.sensor_height}x{motion.sensor_width} pixels (height x width)"
    pace = f"{motion.duration_s:g} s at {motion.frame_rate_hz:g} frames a second"
    return f"Sequences of {size}, {pace}; sensor: model {config.emulate.model}."


def _make_scenes(options: argparse.Namespace, config: Config, root: Path, work: Path) -> list[str]:
    """Simulate the pictures of a folder; returns a line for each file that was skipped."""
    try:
        make_folder_set(root, options.kind, work, config.recipe, config.mapper, options.limit)
    except ValueError as error:
        raise ValueError(f"--scenes {root}: no scene to score. {error}") from error
    manifest = read_manifest(work / "images")
    simulated = sorted(set(SceneStore.open(work / "scenes.zarr").scene_of.values()))
    print(f"scenes: {len(simulated)}, {', '.join(simulated[:5])}{', ...' if len(simulated) > 5 else ''}")
    unused = dataclasses.replace(manifest, pictures=tuple(e for e in manifest.pictures if e.name not in simulated))
    _, small = motions_of(unused, config.synthesize, config.seed)
    return [f"{skipped.file} was skipped: {skipped.reason}" for skipped in (*manifest.skipped, *small)]
