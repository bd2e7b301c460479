"""The benchmark on a user's own folder of photographs, measured polarization or recordings, without training."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from polarnet.analysis.conditions import announced, configured
from polarnet.analysis.recorded import make_recorded_set
from polarnet.benchmark.results import write_benchmark
from polarnet.benchmark.rows import Context, available, metadata_used, weights_used
from polarnet.benchmark.run import run_benchmark
from polarnet.benchmark.sequences import train_mean_dolp
from polarnet.config.pipeline import context_of, made_set
from polarnet.config.tree import Config, with_lpips
from polarnet.methods import is_rotating
from polarnet.metrics.lpips import NO_RECORD, Weights, find_weights
from polarnet.metrics.similarity import Lpips
from polarnet.networks.weights import shipped_weights
from polarnet.pictures.manifest import read_manifest
from polarnet.recordings.noise import Cleaning
from polarnet.reports.page import write_set_page
from polarnet.runtime.machine import on_one_thread
from polarnet.simulation.rotating import emulate_rotating_scenes
from polarnet.simulation.sets import make_folder_set
from polarnet.simulation.truth import motions_of
from polarnet.stokes import Mosaic
from polarnet.storage.frames import FrameStore
from polarnet.storage.scenes import SceneStore

SET_THEM = "To score on sequences like those of the training, add to the command, or write into params.yaml:"


RECORDED = {
    "sentence": "Windows lie between the recordings' frames, whose polarization is the truth.",
    "recorded": True,
    "warnings": [],
}


class Request(NamedTuple):
    """A folder to score, and where the results go."""

    root: Path
    out: Path
    """Receives metrics.json, cost.json, details.json, frames.csv, panels and index.html."""
    work: Path
    """Receives pictures, scenes and events, so a stopped run resumes and a second run only runs the methods."""
    weights: Path | None
    """Checkpoint of the DoLP network; None uses the shipped one."""
    command: str


class Inputs(NamedTuple):
    """Inputs of a run besides its test set, and the methods that cannot run."""

    context: Context
    methods: list[str]
    left_out: dict[str, str]
    """Reason by row."""
    lpips: Weights | None


def benchmark_folder(config: Config, request: Request, kind: str, limit: int | None = None) -> list[str]:
    """Run the benchmark on a folder of photographs or measured scenes, without training; return the notes.

    `limit` is the maximum number of pictures. Methods without weights are left out and unusable files are skipped; the
    notes list both. Size, duration and sensor are printed first, with a warning if a network was trained with others.
    Raises ValueError if the folder has no usable file, or if the weights for an LPIPS column are missing.
    """
    inputs = _inputs(config, request.weights)
    used = configured(config.synthesize, config.emulate)
    conditions = announced(used, metadata_used(inputs.methods, inputs.context), SET_THEM)
    try:
        make_folder_set(request.root, kind, request.work, config.recipe, config.mapper, limit)
    except ValueError as error:
        raise ValueError(f"--scenes {request.root}: no scene to score. {error}") from error
    notes = [*_skipped(config, request.work), *(_left_out(row, reason) for row, reason in inputs.left_out.items())]
    rotating = _rotating_events(config, request.work) if any(map(is_rotating, inputs.methods)) else None
    _scored(config, inputs, request, rotating, {"conditions": conditions, "left_out": notes})
    return notes


def benchmark_recordings(config: Config, request: Request, mosaic: Mosaic, cleaning: Cleaning) -> list[str]:
    """Run the benchmark on a folder of recordings with true polarization, as `benchmark_folder` does on scenes.

    Windows lie between the recordings' frames.
    """
    inputs = _inputs(config, request.weights)
    for row in filter(is_rotating, inputs.methods):
        inputs.left_out[row] = "recordings hold the events of four channels, not those behind a rotating polarizer"
    inputs = inputs._replace(methods=[row for row in inputs.methods if not is_rotating(row)])
    try:
        notes = make_recorded_set(request.root, request.work, mosaic, cleaning)
    except ValueError as error:
        raise ValueError(f"--recordings {error}") from error
    notes += [_left_out(row, reason) for row, reason in inputs.left_out.items()]
    _scored(config, inputs, request, None, {"conditions": RECORDED, "left_out": notes})
    return notes


def _inputs(config: Config, weights: Path | None) -> Inputs:
    if weights is not None and not weights.is_file():
        raise ValueError(
            f"--weights {weights}: expected a checkpoint of the DoLP network (.safetensors), found no such file"
        )
    lpips = with_lpips(config, "benchmark", find_weights)  # the pipeline need not have found them before
    wanted = [*config.benchmark.methods, *(["ours"] if weights and "ours" not in config.benchmark.methods else [])]
    context = context_of(config, wanted, _train_mean(config), weights or shipped_weights())
    return Inputs(context, *available(wanted, context), lpips)


def _scored(config: Config, inputs: Inputs, request: Request, rotating: Path | None, about: Mapping[str, Any]) -> None:
    """Run the rows on the set in the folder `work` and write scores and page."""
    test_set = made_set(request.root.resolve().name, request.work, rotating)
    settings = dataclasses.replace(config.benchmark, methods=inputs.methods)
    lpips = None if inputs.lpips is None else Lpips.of(inputs.lpips.backbone, inputs.lpips.tensors)
    mapper = config.mapper("benchmark")

    def mapped(task: Callable[[str], Any], names: Sequence[str]) -> list[Any]:
        return mapper(functools.partial(on_one_thread, task), names)

    benchmark = run_benchmark(test_set, inputs.context, settings, lpips, mapped)
    details = {
        "set": test_set.name,
        "lpips": NO_RECORD if inputs.lpips is None else inputs.lpips.record,
        "train_mean": inputs.context.train_mean,
        "weights": weights_used(inputs.methods, inputs.context),
        **about,
    }
    write_benchmark(request.out, benchmark, settings, config.seed, details)
    notes = [*about["conditions"]["warnings"], *about["left_out"]]
    write_set_page(request.out, test_set.name, request.command, notes)


def _rotating_events(config: Config, work: Path) -> Path:
    """Emulate the scenes behind a rotating polarizer; returns the path of the events."""
    events = work / "rotating.zarr"
    mapper = config.mapper("emulate_rotating")
    emulate_rotating_scenes(work / "scenes.zarr", events, config.rotating, config.camera, config.seed, mapper)
    return events


def _skipped(config: Config, work: Path) -> list[str]:
    """One line for each file of the folder that was skipped."""
    manifest = read_manifest(work / "images")
    simulated = set(SceneStore.open(work / "scenes.zarr").scene_of.values())
    unused = dataclasses.replace(manifest, pictures=tuple(e for e in manifest.pictures if e.name not in simulated))
    _, small = motions_of(unused, config.synthesize, config.seed)
    return [f"{skipped.file} was skipped: {skipped.reason}" for skipped in (*manifest.skipped, *small)]


def _train_mean(config: Config) -> float | None:
    """Mean DoLP of the pipeline's training split; None if the pipeline has not made the split."""
    frames = Path(config.paths.frames)
    return train_mean_dolp(FrameStore.open(frames), config.benchmark.warmup_windows) if frames.exists() else None


def _left_out(row: str, reason: str) -> str:
    """One line for a method that cannot run."""
    return f"{row} was left out: {reason}."
