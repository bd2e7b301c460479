"""Results of one row on every test set, as a folder of its own; the table is put together from such folders.

ROW/row.json                 why the row was left out, or null; the weights that it used
ROW/SET/results.json         scores of each frame, cost, sums of the expected errors
ROW/SET/panels/SEQUENCE.npz  one window: its events, the truth and the row's prediction
"""

import dataclasses
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from polarnet.benchmark.run import Benchmark
from polarnet.benchmark.score import Cost, FrameScore
from polarnet.metrics.reliability import Reliability
from polarnet.runtime.files import check_seal, seal
from polarnet.storage.panels import Panel, read_panel, write_panel

MADE_BY = "run `dvc repro`, or `python -m stages.row` for all rows"


class RowRecord(NamedTuple):
    """Content of row.json."""

    left_out: str | None
    """Reason why the row could not run; None if it ran."""
    weights: Mapping[str, Mapping[str, str]]
    """File name, sha256 and network by section of `methods`; empty for a row without weights."""


def write_row(folder: Path, row: str, record: RowRecord, sets: Mapping[str, Benchmark]) -> None:
    """Write `folder` anew with the results of `row` on each set; row.json comes last and marks the folder complete."""
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
            write_panel(folder / name / "panels", panel, [row])
    (folder / "row.json").write_text(json.dumps(record._asdict(), indent=2) + "\n")
    seal(folder)


def read_record(folder: Path) -> RowRecord:
    """Content of row.json; FileNotFoundError if the row was not run, ValueError if a file of the folder has changed."""
    if not (folder / "row.json").exists():
        raise FileNotFoundError(f"{folder / 'row.json'} is missing: row {folder.name} was not run; {MADE_BY}")
    check_seal(folder)
    return RowRecord(**json.loads((folder / "row.json").read_text()))


def read_rows(folders: Mapping[str, Path], test_set: str) -> Benchmark:
    """Results of several rows on one set, each from its folder, as if they had run together.

    FileNotFoundError if a row has not run on this set. ValueError if rows have other sequences or panels than the
    first row.
    """
    frames: dict[str, list[FrameScore]] = {}
    costs: dict[str, Cost] = {}
    sums: dict[str, Reliability] = {}
    panels: dict[str, dict[str, Panel]] = {}
    for row, folder in folders.items():
        file = folder / test_set / "results.json"
        if not file.exists():
            raise FileNotFoundError(f"{file} is missing: row {row} has not run on set {test_set}; {MADE_BY}")
        results = json.loads(file.read_text())
        frames[row] = [FrameScore(row, *score) for score in results["frames"]]
        costs[row] = Cost(**results["cost"])
        if results["reliability"] is not None:
            sums[row] = Reliability(*(torch.tensor(sum_, dtype=torch.float64) for sum_ in results["reliability"]))
        panels[row] = {file.stem: read_panel(file) for file in (folder / test_set / "panels").glob("*.npz")}
    first = next(iter(folders))
    sequences = _sequences(frames[first])
    for row in folders:
        if _sequences(frames[row]) != sequences or set(panels[row]) != set(panels[first]):
            raise ValueError(
                f"row {row} was scored on other sequences of set {test_set} than row {first}: run both again, {MADE_BY}"
            )
    ordered = [score for name in sequences for row in folders for score in frames[row] if score.sequence == name]
    together = [_together([panels[row][name] for row in folders]) for name in sequences if name in panels[first]]
    return Benchmark(ordered, costs, together, sums)


def _sequences(frames: Sequence[FrameScore]) -> list[str]:
    return list(dict.fromkeys(score.sequence for score in frames))


def _together(panels: Sequence[Panel]) -> Panel:
    """One panel with the predictions of all of `panels`, which show the same window."""
    return dataclasses.replace(
        panels[0], predictions={row: one for panel in panels for row, one in panel.predictions.items()}
    )
