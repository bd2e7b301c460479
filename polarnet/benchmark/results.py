"""Result files: a folder of each row on every test set, and the whole table of a set put together from them.

ROW/row.json                 why the row was left out, or null; the weights that it used
ROW/SET/results.json         scores of each frame, cost, sums of the expected errors
ROW/SET/panels/SEQUENCE.npz  one window: its events, the truth and the row's prediction
"""

import csv
import dataclasses
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

from polarnet.benchmark.run import Benchmark
from polarnet.benchmark.score import (
    METRICS,
    BenchmarkConfig,
    Cost,
    FrameScore,
    paired_comparisons,
    scene_means,
    summary,
)
from polarnet.metrics.reliability import Reliability
from polarnet.runtime.files import check_seal, publish, seal
from polarnet.storage.panels import read_panel, write_panel

MADE_BY = "run `dvc repro`, or `python -m stages.row` for all rows"


class RowRecord(NamedTuple):
    """Content of row.json."""

    row: str
    """Its name, so that a copy under another is found out."""
    left_out: str | None
    """Reason why the row could not run; None if it ran."""
    weights: Mapping[str, Mapping[str, str]]
    """File name, sha256 and network by section of `methods`; empty for a row without weights."""


def write_row(folder: Path, row: str, record: RowRecord, sets: Mapping[str, Benchmark]) -> None:
    """Publish `folder` with the results of `row` on each set."""
    place, folder = folder, folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, benchmark in sets.items():
        (folder / name / "panels").mkdir(parents=True)
        sums = benchmark.reliability.get(row)
        results = {
            "frames": [score[1:] for score in benchmark.rows if score.method == row],
            "cost": dataclasses.asdict(benchmark.costs[row]),
            "reliability": None if sums is None else [sum_.tolist() for sum_ in dataclasses.astuple(sums)],
        }
        (folder / name / "results.json").write_text(json.dumps(results) + "\n")
        for panel in benchmark.panels:
            own = dataclasses.replace(panel, predictions={row: panel.predictions[row]})
            write_panel(folder / name / "panels", own)
    (folder / "row.json").write_text(json.dumps(record._asdict(), indent=2) + "\n")
    seal(folder)
    publish(folder, place)


def read_record(folder: Path) -> RowRecord:
    """Content of row.json; FileNotFoundError if the row was not run, ValueError if the folder has another row's files.

    ValueError, too, if a file of the folder has changed.
    """
    if not (folder / "row.json").exists():
        raise FileNotFoundError(f"{folder / 'row.json'} is missing: row {folder.name} was not run; {MADE_BY}")
    check_seal(folder)
    record = RowRecord(**json.loads((folder / "row.json").read_text()))
    if record.row != folder.name:
        raise ValueError(f"{folder}: expected row {folder.name}, got a copy of row {record.row}; {MADE_BY}")
    return record


def read_rows(folders: Mapping[str, Path], test_set: str) -> Benchmark:
    """Results of several rows on one set, each from its folder, as if they had run together.

    FileNotFoundError if a row has not run on this set. ValueError if rows have other sequences or panels than the
    first row.
    """
    rows = {row: _read_row(row, folder / test_set) for row, folder in folders.items()}
    first = next(iter(rows))
    for row, results in rows.items():
        if _sequences(results) != _sequences(rows[first]):
            raise ValueError(
                f"row {row} was scored on other sequences of set {test_set} than row {first}: run both again, {MADE_BY}"
            )
    sequences, _ = _sequences(rows[first])
    ordered = [score for name in sequences for one in rows.values() for score in one.rows if score.sequence == name]
    panels = []
    for of_rows in zip(*(one.panels for one in rows.values()), strict=True):
        predictions = {row: panel.predictions[row] for row, panel in zip(rows, of_rows, strict=True)}
        panels.append(dataclasses.replace(of_rows[0], predictions=predictions))
    costs = {row: one.costs[row] for row, one in rows.items()}
    sums = {row: one.reliability[row] for row, one in rows.items() if row in one.reliability}
    return Benchmark(ordered, costs, panels, sums)


def _read_row(row: str, folder: Path) -> Benchmark:
    """Results of one row on one set."""
    file = folder / "results.json"
    if not file.exists():
        raise FileNotFoundError(f"{file} is missing: row {row} has not run on set {folder.name}; {MADE_BY}")
    results = json.loads(file.read_text())
    sums = [torch.tensor(column, dtype=torch.float64) for column in results["reliability"] or ()]
    panels = [read_panel(path) for path in sorted((folder / "panels").glob("*.npz"))]
    scores = [FrameScore(row, *score) for score in results["frames"]]
    return Benchmark(scores, {row: Cost(**results["cost"])}, panels, {row: Reliability(*sums)} if sums else {})


def _sequences(results: Benchmark) -> tuple[list[str], list[str]]:
    """Sequences of a row, and those with a panel."""
    return list(dict.fromkeys(score.sequence for score in results.rows)), [panel.sequence for panel in results.panels]


def write_benchmark(
    folder: Path, benchmark: Benchmark, config: BenchmarkConfig, seed: int, about: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Write metrics.json, cost.json, details.json (`about`, settings), frames.csv and panels/SEQUENCE.npz.

    Metrics depend on the settings and the seed alone; costs depend on the machine. Returns both, by method.
    """
    shutil.rmtree(folder / "panels", ignore_errors=True)  # an earlier run may have saved other scenes
    (folder / "panels").mkdir(parents=True)
    backbone = {"lpips_backbone": config.lpips_backbone} if config.lpips else {}
    scores = summary(benchmark.rows, config.bootstrap_samples, seed)
    metrics: dict[str, dict[str, Any]] = {method: {**scores[method], **backbone} for method in scores}
    costs = {method: dataclasses.asdict(benchmark.costs[method]) for method in scores}
    means = {metric: scene_means(benchmark.rows, metric) for metric in METRICS}
    details = {
        **about,
        "scenes": sorted({row.scene for row in benchmark.rows}),
        "sequences": sorted({row.sequence for row in benchmark.rows}),
        "frames": len(benchmark.rows) // len(config.methods),
        "warmup_windows": config.warmup_windows,
        "precision": config.precision,
        "bootstrap_samples": config.bootstrap_samples,
        "scene_means": {metric: of_methods for metric, of_methods in means.items() if of_methods},
        "paired": paired_comparisons(benchmark.rows, "ours"),
        "reliability": {
            method: {"curve": sums.curve(), "log_error": sums.log_error()}
            for method, sums in benchmark.reliability.items()
        },
    }
    for name, content in (("metrics", metrics), ("cost", costs), ("details", details)):
        (folder / f"{name}.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    with (folder / "frames.csv").open("w", newline="") as file:  # metrics that were not computed are empty cells
        csv.writer(file, lineterminator="\n").writerows([FrameScore._fields, *benchmark.rows])
    for panel in benchmark.panels:
        write_panel(folder / "panels", panel)
    return {method: {**metrics[method], **costs[method]} for method in metrics}
