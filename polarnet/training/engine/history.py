"""History of a training in history.csv: one line for each epoch, which DVC plots, the report and sweeps read."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from polarnet.runtime.files import check_seal

HISTORY = "history.csv"

Row = Mapping[str, Any]
"""An epoch: `epoch` (from 0), `train` (mean loss terms by name) and `val` (validation scores by name)."""


def write_history(folder: Path, rows: Sequence[Row]) -> None:
    """Write the columns epoch, train_TERM and val_SCORE."""
    lines = [
        {"epoch": row["epoch"]}
        | {f"{split}_{name}": value for split in ("train", "val") for name, value in row[split].items()}
        for row in rows
    ]
    with (folder / HISTORY).open("w", newline="") as file:
        writer = csv.DictWriter(file, lines[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)


def read_history(folder: Path) -> list[Row]:
    """Read what `write_history` wrote, to the last digit; ValueError for a changed file or one without epochs."""
    check_seal(folder, [HISTORY])
    with (folder / HISTORY).open(newline="") as file:
        lines = list(csv.DictReader(file))
    if not lines:
        raise ValueError(f"{folder / HISTORY}: expected a line for each epoch, got none; train again")

    def values(line: Mapping[str, str], split: str) -> dict[str, float]:
        return {name.removeprefix(split): float(value) for name, value in line.items() if name.startswith(split)}

    return [
        {"epoch": int(line["epoch"]), "train": values(line, "train_"), "val": values(line, "val_")} for line in lines
    ]


def best_row(rows: Sequence[Row]) -> Row:
    """Return the epoch with the smallest validation MSE; the first one if several are equal."""
    return min(rows, key=lambda row: row["val"]["mse"])
