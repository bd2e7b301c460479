"""Outputs of a training: checkpoints, history, and the running checkpoint for resuming a killed run.

The outputs contain no dates or durations, so equal trainings write equal bytes. The history, history.csv, has one line
for each epoch, which DVC plots and the report and sweeps read.
"""

import contextlib
import csv
import json
import math
import shutil
import time
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from polarnet.networks.base.checkpoint import save_checkpoint
from polarnet.runtime.files import check_seal, claimed, code_digest, publish, replaced, seal, sha256
from polarnet.terminal.progress import ProgressBar
from polarnet.training.engine.optimizers import Optimizer
from polarnet.training.engine.parallel import place
from polarnet.training.engine.sequences import Batch

KEEP_EVERY_S = 60.0  # writing a running checkpoint of the paper's network takes 0.1 s
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


@dataclass
class Progress:
    """Progress of a training."""

    epoch: int = 0
    """Number of complete epochs."""
    visits: int = 0
    """Number of visits already trained on in the current epoch."""
    steps: int = 0
    """Number of optimizer steps in the current epoch; `sums` adds up the loss and its terms over them."""
    sums: dict[str, float] = field(default_factory=dict)
    history: list[Row] = field(default_factory=list)
    best: dict[str, Tensor] = field(default_factory=dict)
    """Weights of the epoch with the smallest validation MSE."""

    def add(self, losses: Sequence[Mapping[str, float]], visits: int) -> None:
        """Add the losses of one batch; FloatingPointError if a loss is infinite or NaN."""
        sums = Counter(self.sums)
        for terms in losses:
            if not math.isfinite(terms["total"]):
                raise FloatingPointError(
                    f"the loss is {terms['total']} in epoch {self.epoch + 1} after {self.steps} steps; lower "
                    "learning_rate, set gradient_norm, or use precision=fp32"
                )
            sums.update(terms)
        self.sums, self.steps, self.visits = dict(sums), self.steps + len(losses), self.visits + visits

    def end_epoch(self, weights: Mapping[str, Tensor], scores: Mapping[str, float]) -> None:
        """Add a row to the history, keep the weights if they are the best, and start the next epoch."""
        means = {name: value / self.steps for name, value in self.sums.items()}
        self.history.append({"epoch": self.epoch, "train": means, "val": dict(scores)})
        if best_row(self.history) is self.history[-1]:
            self.best = {name: tensor.detach().cpu().clone() for name, tensor in weights.items()}
        self.epoch, self.visits, self.steps, self.sums = self.epoch + 1, 0, 0, {}


class Recorder:
    """Writes the outputs of a training into the folder `out`, and its running checkpoint below `resume`.

    `metadata` records everything that determines the weights. It goes into the JSON of the best and last checkpoints,
    and its hash, with that of the code, names the folder of the running checkpoint. Files lie in OUT.partial until
    `finish`, which publishes them and deletes the running checkpoint. If several processes share a training, only the
    first one writes. ValueError while another training writes into `out`, or while an equal one runs.
    """

    def __init__(self, out: Path, resume: Path, metadata: Mapping[str, Any], keep_every_s: float = KEEP_EVERY_S):
        self.place, self.out = out, out.with_name(f"{out.name}.partial")
        self.metadata, self.keep_every_s = dict(metadata), keep_every_s
        key = sha256(json.dumps(self.metadata, sort_keys=True).encode(), code_digest().encode())
        self.running = resume / key[:16]
        self.kept_at = time.monotonic()
        self.writes = place()[0] == 0
        self._claims = contextlib.ExitStack()
        if self.writes:
            self._claims.enter_context(claimed(out))
            self._claims.enter_context(claimed(self.running))
            shutil.rmtree(self.out, ignore_errors=True)
            self.out.mkdir(parents=True)

    def resume(self, network: nn.Module, optimizer: Optimizer) -> Progress:
        """Restore network and optimizer from the running checkpoint, if there is one; ValueError if it is damaged."""
        file = self.running / "running.pt"
        if not file.exists():
            return Progress()
        content = read_running(file)
        network.load_state_dict(content["network"])
        optimizer.load_state_dict(content["optimizer"])
        progress = Progress(**content["progress"])
        ProgressBar.write(f"resuming in epoch {progress.epoch + 1}, from {file}")
        if self.writes and progress.history and not progress.visits:
            self._write(progress, network)  # __init__ emptied `out`, so the last epoch's files are written again
        return progress

    def keep(self, progress: Progress, network: nn.Module, optimizer: Optimizer, at_once: bool = False) -> None:
        """Write the running checkpoint if `at_once`, or if `keep_every_s` have passed since the last one."""
        if not self.writes or (not at_once and time.monotonic() - self.kept_at < self.keep_every_s):
            return
        self.running.mkdir(parents=True, exist_ok=True)
        states = {"network": network.state_dict(), "optimizer": optimizer.state_dict()}
        with replaced(self.running / "running.pt") as temporary:
            torch.save({**states, "progress": asdict(progress)}, temporary)
        self.kept_at = time.monotonic()

    def show(self, batches: Iterable[Batch], progress: Progress, visits: int, epochs: int) -> Iterator[Batch]:
        """Yield the batches and show a progress bar that counts visits to sequences."""
        epoch, off = f"epoch {progress.epoch + 1}/{epochs}", not self.writes
        with ProgressBar(total=visits, initial=progress.visits, desc=epoch, unit="visit", disable=off) as bar:
            for batch in batches:
                yield batch
                bar.update(len(batch.names))
                bar.set_postfix(loss=f"{progress.sums['total'] / progress.steps:.4f}")

    def end_epoch(self, progress: Progress, network: nn.Module, scores: Mapping[str, float]) -> None:
        """Close the epoch in `progress` and write checkpoints and history."""
        progress.end_epoch(network.state_dict(), scores)
        if not self.writes:
            return
        ProgressBar.write("  validation: " + "  ".join(f"{name} {value:.4f}" for name, value in scores.items()))
        self._write(progress, network)

    def calibrated(self, progress: Progress, network: nn.Module, expected_errors: Mapping[str, int | float]) -> None:
        """Rewrite the best checkpoint with the fitted expected errors of `network` and the record of the fit."""
        best = best_row(progress.history)
        self._save("best", network.state_dict(), best, expected_errors=dict(expected_errors))
        seal(self.out)

    def finish(self) -> None:
        """Publish the files and delete the running checkpoint, because the training is complete."""
        if self.writes:
            publish(self.out, self.place)
            shutil.rmtree(self.running, ignore_errors=True)
            self._claims.close()

    def _write(self, progress: Progress, network: nn.Module) -> None:
        last, best = progress.history[-1], best_row(progress.history)
        self._save("last", network.state_dict(), last)
        self._save("best", progress.best, best)
        write_history(self.out, progress.history)
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
