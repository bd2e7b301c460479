"""The benchmark's tables of a configuration, put together from the results of its rows."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

from polarnet.benchmark.results import read_record, read_rows, write_benchmark
from polarnet.config.pipeline import row_folder, rows_of_set, set_folder, set_names, train_mean_of
from polarnet.config.tree import DOLP_TRAINING, Config
from polarnet.metrics.lpips import record_of
from polarnet.terminal.progress import ProgressBar
from polarnet.training.engine.recorder import HISTORY


def collect_rows(config: Config) -> dict[str, dict[str, dict[str, Any]]]:
    """Write each set's table and metrics.json from the folders of `benchmark.methods`; returns scores by set and row.

    FileNotFoundError names a row that was not run; ValueError if every row was left out.
    """
    records = {row: read_record(row_folder(config, row)) for row in config.benchmark.methods}
    left_out = {row: record.left_out for row, record in records.items() if record.left_out is not None}
    folders = {row: row_folder(config, row) for row in records if row not in left_out}
    if not folders:
        reasons = "; ".join(f"{row}: {reason}" for row, reason in left_out.items())
        raise ValueError(f"benchmark.methods: expected at least one row that can run, got none ({reasons})")
    about = {
        "lpips": record_of(config.benchmark.lpips_backbone if config.benchmark.lpips else None),
        "train_mean": train_mean_of(config),
        "left_out": left_out,
        "weights": {section: file for record in records.values() for section, file in record.weights.items()},
    }
    benchmark = Path(config.paths.benchmark)
    shutil.rmtree(benchmark / "sets", ignore_errors=True)  # an earlier run may have had other sets
    tables = {}
    for name in ProgressBar(set_names(config), "tables", unit="set"):
        here = {row: folders[row] for row in rows_of_set(name, list(folders))}
        settings, of_set = dataclasses.replace(config.benchmark, methods=list(here)), {"set": name, **about}
        tables[name] = write_benchmark(set_folder(config, name), read_rows(here, name), settings, config.seed, of_set)
    scores = {name: json.loads((set_folder(config, name) / "metrics.json").read_text()) for name in tables}
    (benchmark / "metrics.json").write_text(json.dumps(scores, indent=2) + "\n")
    return tables


def copy_histories(config: Config) -> None:
    """Copy the history of each training in use to history/NAME.csv in the benchmark's folder, for `dvc plots`."""
    folder = Path(config.paths.benchmark) / "history"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in (DOLP_TRAINING, *config.used_baselines):
        shutil.copy(Path(config.paths.train) / name / HISTORY, folder / f"{name}.csv")
