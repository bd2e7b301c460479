"""The benchmark as a configuration asks for it: what methods get, and on which test sets they run."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from polarnet.cluster import pmap
from polarnet.config import Config
from polarnet.evaluation.benchmark import BenchmarkSet, run_benchmark, train_mean_dolp, write_benchmark
from polarnet.evaluation.rows import Context, available, weights_used
from polarnet.events.frames import FrameStore
from polarnet.events.store import EventStore
from polarnet.lpips import NO_RECORD, stored_record
from polarnet.methods import METHODS
from polarnet.methods.method import Method, Setup
from polarnet.runtime import device_of
from polarnet.similarity import Lpips

RECORDINGS = "recordings"  # the set of real targets


def context_of(config: Config, train_mean: float | None, weights: Path | None = None) -> Context:
    """What the rows of the benchmark get; `weights` replaces those of `ours` that the pipeline trained."""
    given = {"ours": weights} if weights else {}
    setups = {
        method.section: setup_of(config, method, given.get(method.section))
        for method in METHODS.values()
        if method.wraps is None
    }
    return Context(train_mean, setups, device_of(config.runtime))


def setup_of(config: Config, method: Method, weights: Path | None = None) -> Setup:
    """What a method gets; `weights` comes before its section, and that before what its training stage left."""
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
    """A map over sequences, as the configuration shares them out."""
    return functools.partial(pmap, workers=config.runtime.workers, label=label, address=config.cluster.address)


def pipeline_set(config: Config, name: str) -> BenchmarkSet:
    """One of `benchmark.sets`, as the pipeline made it."""
    if name == "simulated":
        return BenchmarkSet(name, EventStore.open(config.paths.events), FrameStore.open(config.paths.frames))
    return made_set(name, Path(config.paths.sets) / name)


def made_set(name: str, folder: Path) -> BenchmarkSet:
    """A set that `polarnet.simulation.sets` made under `folder`."""
    return BenchmarkSet(name, EventStore.open(folder / "events.zarr"), FrameStore.open(folder / "frames.zarr"))


def set_folder(config: Config, name: str) -> Path:
    """Where the results of a set lie: the simulated one's in the benchmark's folder, others below it."""
    folder = Path(config.paths.benchmark)
    return folder if name == "simulated" else folder / "sets" / name


def run_pipeline_benchmark(config: Config, lpips: Lpips | None) -> dict[str, dict[str, dict[str, Any]]]:
    """Run all of `benchmark.sets` and write what each gave; set, then method: the metrics.

    Real targets are one more set, `RECORDINGS`, while `recordings.enabled` is true. `lpips` is that of `lpips_of`.
    """
    (Path(config.paths.benchmark) / "sets").mkdir(parents=True, exist_ok=True)
    tests = {name: pipeline_set(config, name) for name in config.benchmark.sets}
    if config.recordings.enabled:
        tests[RECORDINGS] = made_set(RECORDINGS, Path(config.paths.calibrated))
    return {name: run_on(config, test_set, lpips, set_folder(config, name)) for name, test_set in tests.items()}


def lpips_of(config: Config) -> Lpips | None:
    """The table's LPIPS, from what stage `weights` left; None where it is no column. ValueError where it left none."""
    if not config.benchmark.lpips:
        return None
    return Lpips.load(config.paths.weights, "benchmark", config.benchmark.lpips_backbone)


def run_on(config: Config, test_set: BenchmarkSet, lpips: Lpips | None, folder: Path) -> dict[str, dict[str, Any]]:
    """Run the methods whose weights are there on a set, write what they gave to `folder`; method: the metrics."""
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
    """Where predictions and scores are kept between runs."""
    return Path(config.paths.cache) / "benchmark"
