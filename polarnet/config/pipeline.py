"""The benchmark of a configuration: the inputs of the methods, the test sets, and running rows on them."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from polarnet.benchmark.results import RowRecord, write_row
from polarnet.benchmark.rows import Context, available, weights_used
from polarnet.benchmark.run import run_benchmark
from polarnet.benchmark.sequences import BenchmarkSet, train_mean_dolp
from polarnet.config.tree import Config
from polarnet.events.rotation import steady_rotation
from polarnet.methods import METHODS, is_rotating
from polarnet.methods.method import Method, Setup
from polarnet.metrics.lpips import Lpips
from polarnet.metrics.references import REFERENCES
from polarnet.runtime.machine import device_of
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore

RECORDINGS = "recordings"  # name of the test set of real targets


def context_of(config: Config, rows: Iterable[str], train_mean: float | None, weights: Path | None = None) -> Context:
    """Inputs of rows of the benchmark; `weights` replaces the weights of `ours` in section `rows`."""
    setups: dict[str, Setup] = {}
    for method in (METHODS[row] for row in rows if row in METHODS):
        setups.setdefault(method.section, setup_of(config, method, weights if method.section == "ours" else None))
    return Context(train_mean, setups, device_of(config.runtime))


def setup_of(config: Config, method: Method, weights: Path | None = None) -> Setup:
    """Inputs of a method, with `weights`, else those that section `rows` names.

    A row NAME+gain that is not listed has the weights of NAME.
    """
    if weights is None and method.networks:
        weights = config.weights_of(method.name) or config.weights_of(method.section)
    rotation = None
    if method.rotating:  # as the pipeline's events were made; without them, as section `rotating` says
        events = Path(config.paths.rotating) / f"{config.benchmark.sets[0]}.zarr"
        made = EventStore.open(events).attributes["rotating"] if events.exists() else vars(config.rotating)
        rotation = steady_rotation(made["rate_hz"], math.radians(made["start_angle_deg"]))
    return Setup(
        config=getattr(config.methods, method.section, None),
        weights=weights,
        gain=config.methods.gain,
        registration=config.methods.registration,
        device=device_of(config.runtime),
        precision=config.benchmark.precision,
        rotation=rotation,
    )


def pipeline_set(config: Config, name: str, rows: Sequence[str] = ()) -> BenchmarkSet:
    """Open a test set that the pipeline made, with what `rows` need: one of `benchmark.sets`, or `RECORDINGS`."""
    if name == RECORDINGS:
        return made_set(RECORDINGS, Path(config.paths.calibrated))
    rotating = Path(config.paths.rotating) / f"{name}.zarr" if any(map(is_rotating, rows)) else None
    if name == "simulated":
        return _set_of(name, Path(config.paths.events), Path(config.paths.frames), rotating)
    return made_set(name, Path(config.paths.sets) / name, rotating)


def made_set(name: str, folder: Path, rotating: Path | None = None) -> BenchmarkSet:
    """Open a test set that `polarnet.simulation.sets` made in `folder`, and its events behind a rotating polarizer."""
    return _set_of(name, folder / "events.zarr", folder / "frames.zarr", rotating)


def _set_of(name: str, events: Path, frames: Path, rotating: Path | None) -> BenchmarkSet:
    further = None if rotating is None else EventStore.open(rotating)
    return BenchmarkSet(name, EventStore.open(events), FrameStore.open(frames), further)


def rows_of_set(name: str, rows: Sequence[str]) -> list[str]:
    """The rows that a test set can score: real targets were recorded by four channels."""
    return [row for row in rows if name != RECORDINGS or not is_rotating(row)]


def set_folder(config: Config, name: str) -> Path:
    """Folder of a set's results."""
    return Path(config.paths.benchmark) / "sets" / name


def row_folder(config: Config, row: str) -> Path:
    """Folder of a row's own results, from which the table is put together."""
    return Path(config.paths.benchmark) / "rows" / row


def set_names(config: Config) -> list[str]:
    """Test sets of the benchmark: `benchmark.sets`, and the real targets if `recordings.enabled` is true."""
    return [*config.benchmark.sets, *([RECORDINGS] if config.recordings.enabled else [])]


def run_rows(config: Config, rows: Sequence[str]) -> None:
    """Run rows on every test set, in one pass over the events of each, and write a folder of each row.

    A row that cannot run gets a folder with the reason. ValueError if LPIPS weights are missing.
    """
    needs_mean = any(row in REFERENCES and REFERENCES[row].needs_train_mean for row in rows)
    context = context_of(config, rows, train_mean_of(config) if needs_mean else None)
    methods, left_out = available(rows, context)
    for row, reason in left_out.items():
        print(f"{row} is left out: {reason}")
        write_row(row_folder(config, row), row, RowRecord(row, reason, {}), {})
    if not methods:
        return
    lpips, results = lpips_of(config), {}
    for name in set_names(config):
        if here := rows_of_set(name, methods):
            test_set, settings = pipeline_set(config, name, here), dataclasses.replace(config.benchmark, methods=here)
            results[name] = run_benchmark(test_set, context, settings, lpips, config.mapper(name))
    for row in methods:
        own = {name: benchmark for name, benchmark in results.items() if row in benchmark.costs}
        write_row(row_folder(config, row), row, RowRecord(row, None, weights_used([row], context)), own)


def lpips_of(config: Config) -> Lpips | None:
    """LPIPS of the table; None without LPIPS, ValueError without its weights."""
    return Lpips.load(config.benchmark.lpips_backbone) if config.benchmark.lpips else None


def train_mean_of(config: Config) -> float:
    """Mean DoLP of the pipeline's training split, over what the benchmark scores."""
    return train_mean_dolp(FrameStore.open(config.paths.frames), config.benchmark.warmup_windows)
