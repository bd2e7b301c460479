"""Outputs of a training: checkpoints, history, and the running checkpoint for resuming a killed run.

The outputs contain no dates or durations, so equal trainings write equal bytes. The history, history.csv, has one line
for each epoch, which DVC plots and the report and sweeps read.
"""

import contextlib
import csv
import json
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from polarnet.networks.base.checkpoint import save_checkpoint
from polarnet.runtime.files import check_seal, claimed, code_digest, publish, replaced, seal, sha256
from polarnet.terminal.progress import ProgressBar
from polarnet.training.engine.optimizers import Optimizer

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
    rows: list[Row] = []
    for line in lines:
        row: dict[str, Any] = {"epoch": int(line.pop("epoch")), "train": {}, "val": {}}
        for name, value in line.items():
            split, _, score = name.partition("_")
            row[split][score] = float(value)
        rows.append(row)
    return rows


def best_row(rows: Sequence[Row]) -> Row:
    """Return the epoch with the smallest validation MSE; the first one if several are equal."""
    return min(rows, key=lambda row: row["val"]["mse"])


class Recorder:
    """Writes the outputs of a training into the folder `out`, and its running checkpoint below `resume`.

    `metadata` records everything that determines the weights. It goes into the JSON of the best and last checkpoints,
    and its hash, with that of the code, names the folder of the running checkpoint. Files lie in OUT.partial until
    `finish`, which publishes them and deletes the running checkpoint. ValueError while another training writes into
    `out`, or while an equal one runs.
    """

    def __init__(self, out: Path, resume: Path, metadata: Mapping[str, Any]):
        self.place, self.out = out, out.with_name(f"{out.name}.partial")
        self.metadata = dict(metadata)
        key = sha256(json.dumps(self.metadata, sort_keys=True).encode(), code_digest().encode())
        self.running = resume / key[:16]
        self.history: list[Row] = []
        """Complete epochs."""
        self.best: dict[str, Tensor] = {}
        """Weights of the epoch with the smallest validation MSE."""
        self._claims = contextlib.ExitStack()
        self._claims.enter_context(claimed(out))
        self._claims.enter_context(claimed(self.running))
        shutil.rmtree(self.out, ignore_errors=True)
        self.out.mkdir(parents=True)

    def resume(self, network: nn.Module, optimizer: Optimizer) -> None:
        """Restore everything from the running checkpoint, if there is one; ValueError if it is damaged."""
        file = self.running / "running.pt"
        if not file.exists():
            return
        content = read_running(file)
        network.load_state_dict(content["network"])
        optimizer.load_state_dict(content["optimizer"])
        self.history, self.best = content["history"], content["best"]
        ProgressBar.write(f"resuming after epoch {len(self.history)}, from {file}")
        self._write(network)  # __init__ emptied `out`

    def end_epoch(
        self, network: nn.Module, optimizer: Optimizer, means: Mapping[str, float], scores: Mapping[str, float]
    ) -> None:
        """Record mean losses and validation scores; write checkpoints, history and the running checkpoint."""
        self.history.append({"epoch": len(self.history), "train": dict(means), "val": dict(scores)})
        if best_row(self.history) is self.history[-1]:
            self.best = {name: tensor.detach().cpu().clone() for name, tensor in network.state_dict().items()}
        ProgressBar.write("  validation: " + "  ".join(f"{name} {value:.4f}" for name, value in scores.items()))
        self._write(network)
        states = {"network": network.state_dict(), "optimizer": optimizer.state_dict()}
        self.running.mkdir(parents=True, exist_ok=True)
        with replaced(self.running / "running.pt") as temporary:
            torch.save({**states, "history": self.history, "best": self.best}, temporary)

    def calibrated(self, network: nn.Module, expected_errors: Mapping[str, int | float]) -> None:
        """Rewrite the best checkpoint with the fitted expected errors of `network` and the record of the fit."""
        self._save("best", network.state_dict(), best_row(self.history), expected_errors=dict(expected_errors))
        seal(self.out)

    def finish(self) -> None:
        """Publish the files and delete the running checkpoint, because the training is complete."""
        publish(self.out, self.place)
        shutil.rmtree(self.running, ignore_errors=True)
        self._claims.close()

    def _write(self, network: nn.Module) -> None:
        self._save("last", network.state_dict(), self.history[-1])
        self._save("best", self.best, best_row(self.history))
        write_history(self.out, self.history)
        seal(self.out)

    def _save(self, name: str, weights: Mapping[str, Tensor], row: Row, **more: Any) -> None:
        metadata = {**self.metadata, "epoch": row["epoch"], "val": row["val"], **more}
        save_checkpoint(self.out / f"{name}.safetensors", weights, metadata)


def read_running(file: Path) -> dict[str, Any]:
    """A running checkpoint whose bytes all have the checksums in its zip, which torch does not compare.

    ValueError if the file is damaged.
    """
    try:
        with zipfile.ZipFile(file) as entries:
            damaged = entries.testzip()
        if damaged is None:
            return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # torch and zipfile raise many kinds of exceptions
        damaged = str(error)
    raise ValueError(f"{file} is damaged ({damaged}); delete it to start the training anew")
