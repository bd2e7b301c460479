"""The benchmark of a configuration: the inputs of the methods and the test sets on which they run."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from polarnet.benchmark.rows import Context, available, weights_used
from polarnet.benchmark.run import BenchmarkSet, run_benchmark, train_mean_dolp, write_benchmark
from polarnet.config.tree import Config
from polarnet.methods import METHODS
from polarnet.methods.method import Method, Setup
from polarnet.metrics.lpips import NO_RECORD, stored_record
from polarnet.metrics.similarity import Lpips
from polarnet.runtime.cluster import pmap
from polarnet.runtime.machine import device_of
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore

RECORDINGS = "recordings"  # name of the test set of real targets


def context_of(config: Config, train_mean: float | None, weights: Path | None = None) -> Context:
    """Inputs of the benchmark methods; `weights` replaces the pipeline's trained weights of `ours`."""
    given = {"ours": weights} if weights else {}
    setups = {
        method.section: setup_of(config, method, given.get(method.section))
        for method in METHODS.values()
        if method.wraps is None
    }
    return Context(train_mean, setups, device_of(config.runtime))


def setup_of(config: Config, method: Method, weights: Path | None = None) -> Setup:
    """Inputs of a method, with `weights`, else the weights in its section, else those of its training stage."""
    section = getattr(config.methods, method.section)
    if weights is None and method.weights is not None:
        if section.weights:
            weights = Path(section.weights)
        elif method.weights.trained_by:
            weights = Path(getattr(config.paths, method.weights.trained_by)) / "best.safetensors"
    return Setup(
        config=section,
        weights=weights,
        postprocessing=config.baselines.postprocessing,
        gain=config.baselines.gain,
        device=device_of(config.runtime),
        precision=config.benchmark.precision,
    )


def mapper_of(config: Config, label: str) -> Callable[..., list[Any]]:
    """Parallel map over sequences with the workers and cluster of the configuration."""
    return functools.partial(pmap, workers=config.runtime.workers, label=label, address=config.cluster.address)


def pipeline_set(config: Config, name: str) -> BenchmarkSet:
    """Open a test set of `benchmark.sets` that the pipeline made."""
    if name == "simulated":
        return BenchmarkSet(name, EventStore.open(config.paths.events), FrameStore.open(config.paths.frames))
    return made_set(name, Path(config.paths.sets) / name)


def made_set(name: str, folder: Path) -> BenchmarkSet:
    """Open a test set that `polarnet.simulation.sets` made in `folder`."""
    return BenchmarkSet(name, EventStore.open(folder / "events.zarr"), FrameStore.open(folder / "frames.zarr"))


def set_folder(config: Config, name: str) -> Path:
    """Folder of a set's results: the benchmark folder for the simulated set, a subfolder for any other."""
    folder = Path(config.paths.benchmark)
    return folder if name == "simulated" else folder / "sets" / name


def run_pipeline_benchmark(config: Config, lpips: Lpips | None) -> dict[str, dict[str, dict[str, Any]]]:
    """Run the benchmark on all of `benchmark.sets`, write the results, and return the metrics by set and method.

    If `recordings.enabled` is true, the real targets are an additional set, `RECORDINGS`. `lpips` is the result of
    `lpips_of`.
    """
    (Path(config.paths.benchmark) / "sets").mkdir(parents=True, exist_ok=True)
    tests = {name: pipeline_set(config, name) for name in config.benchmark.sets}
    if config.recordings.enabled:
        tests[RECORDINGS] = made_set(RECORDINGS, Path(config.paths.calibrated))
    return {name: run_on(config, test_set, lpips, set_folder(config, name)) for name, test_set in tests.items()}


def lpips_of(config: Config) -> Lpips | None:
    """Load LPIPS for the table with the weights that stage `weights` wrote.

    Returns None if the table has no LPIPS column. Raises ValueError if the weights are missing.
    """
    if not config.benchmark.lpips:
        return None
    return Lpips.load(config.paths.weights, "benchmark", config.benchmark.lpips_backbone)


def run_on(config: Config, test_set: BenchmarkSet, lpips: Lpips | None, folder: Path) -> dict[str, dict[str, Any]]:
    """Run the methods with available weights on a set, write the results to `folder`, return the metrics by method."""
    train_mean = train_mean_dolp(FrameStore.open(config.paths.frames), config.benchmark.warmup_windows)
    context = context_of(config, train_mean)
    methods, left_out = available(config.benchmark.methods, context)
    for method, reason in left_out.items():
        print(f"{method} is left out: {reason}")
    settings = dataclasses.replace(config.benchmark, methods=methods)
    mapper = mapper_of(config, test_set.name)
    benchmark = run_benchmark(test_set, context, settings, lpips, cache_of(config), mapper)
    about = {
        "set": test_set.name,
        "lpips": stored_record(config.paths.weights, "benchmark") if settings.lpips else NO_RECORD,
        "train_mean": train_mean,
        "left_out": left_out,
        "weights": weights_used(methods, context),
        "postprocessing": dataclasses.asdict(config.baselines.postprocessing),
    }
    return write_benchmark(folder, benchmark, settings, config.seed, about)


def cache_of(config: Config) -> Path:
    """Folder that keeps predictions and scores between runs."""
    return Path(config.paths.cache) / "benchmark"
