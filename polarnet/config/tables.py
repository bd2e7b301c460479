"""The tables of a configuration, put together from the results of its rows."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

from polarnet.benchmark.results import write_benchmark
from polarnet.benchmark.row_results import read_record, read_rows
from polarnet.config.pipeline import row_folder, rows_of_set, set_folder, set_names, train_mean_of
from polarnet.config.tree import Config
from polarnet.metrics.lpips import NO_RECORD, stored_record


def collect_rows(config: Config) -> dict[str, dict[str, dict[str, Any]]]:
    """Put the table of each set together from the folders of `benchmark.methods`, whatever other folders exist.

    Returns scores and costs by set and row. FileNotFoundError names a row that was not run; ValueError if every row
    was left out.
    """
    records = {row: read_record(row_folder(config, row)) for row in config.benchmark.methods}
    left_out = {row: record.left_out for row, record in records.items() if record.left_out is not None}
    folders = {row: row_folder(config, row) for row in records if row not in left_out}
    if not folders:
        reasons = "; ".join(f"{row}: {reason}" for row, reason in left_out.items())
        raise ValueError(f"benchmark.methods: expected at least one row that can run, got none ({reasons})")
    about = {
        "lpips": stored_record(config.paths.weights, "benchmark") if config.benchmark.lpips else NO_RECORD,
        "train_mean": train_mean_of(config),
        "left_out": left_out,
        "weights": {section: file for record in records.values() for section, file in record.weights.items()},
        "postprocessing": dataclasses.asdict(config.baselines.postprocessing),
    }
    shutil.rmtree(Path(config.paths.benchmark) / "sets", ignore_errors=True)  # an earlier run may have had other sets
    (Path(config.paths.benchmark) / "sets").mkdir(parents=True)
    tables = {}
    for name in set_names(config):
        here = {row: folders[row] for row in rows_of_set(name, list(folders))}
        settings, of_set = dataclasses.replace(config.benchmark, methods=list(here)), {"set": name, **about}
        tables[name] = write_benchmark(set_folder(config, name), read_rows(here, name), settings, config.seed, of_set)
    return tables
