"""What methods made of sequences and how it scored, kept on disk: a file of each for a method and a sequence.

An entry carries the hash of all that it was made from and counts only while that hash is the same. There is never
more than one entry for a method and a sequence of a set, so that the folder does not grow with every change.
"""

import dataclasses
import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from polarnet.evaluation.cost import Cost
from polarnet.evaluation.reliability import HIGHEST, LOWEST
from polarnet.evaluation.score import FrameScore
from polarnet.evaluation.sequences import TestSequence
from polarnet.events.frames import dequantise_angle, dequantise_fraction, quantise_angle, quantise_fraction
from polarnet.fingerprint import digest
from polarnet.stokes import Prediction

FORMAT = "3"  # part of every hash: raise it when what is stored, or `rows.predictions_of`, changes


def sequence_digest(sequence: TestSequence) -> str:
    """A hash of events, times and truth."""
    parts = [sequence.name, sequence.scene]
    columns = [column for e in sequence.events for column in (e.t, e.x, e.y, e.p)]
    arrays = [*columns, sequence.t_us, sequence.dolp, sequence.aolp, sequence.s0]
    if sequence.valid is not None:
        arrays.append(sequence.valid)
    return digest(*parts, *(np.ascontiguousarray(array.numpy()).tobytes() for array in arrays))


class Cache:
    """The entries of one test set under `folder`, which may not exist yet.

    Predictions are kept in the steps of the stored truth (DoLP in 1/65535, AoLP in pi/65536; the expected error as
    float16), and scored as kept, so that a run that finds them and one that makes them give the same scores.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def prediction(self, method: str, sequence: str, key: str) -> Prediction | None:
        """What `write_prediction` was given under this key, in its steps; None where there is nothing of the kind."""
        path = self._path(method, sequence, "npz")
        try:
            with np.load(path, allow_pickle=False) as arrays:
                if str(arrays["key"]) != key:
                    return None
                return _kept(arrays)
        except (FileNotFoundError, KeyError, ValueError, EOFError, zipfile.BadZipFile):  # absent, or cut short
            return None

    def write_prediction(self, method: str, sequence: str, key: str, prediction: Prediction) -> Prediction:
        """Keep DoLP in [0, 1] and AoLP in radians; what they are in the steps of the store.

        ValueError that names the method and window where a value is not a number.
        """
        for frames in (prediction.dolp, prediction.aolp, prediction.log_variance):
            if frames is not None and not (finite := frames.isfinite().flatten(1).all(dim=1)).all():
                raise ValueError(
                    f"{method} on {sequence}, window {int((~finite).nonzero()[0])}: it recovered values that are not "
                    f"numbers; the method, its weights or the events are damaged"
                )
        arrays = {"dolp": quantise_fraction(prediction.dolp)}
        if prediction.aolp is not None:
            arrays["aolp"] = quantise_angle(_wrapped(prediction.aolp))
        if prediction.log_variance is not None:
            arrays["log_variance"] = prediction.log_variance.clamp(LOWEST, HIGHEST).numpy().astype(np.float16)
        path = self._path(method, sequence, "npz")
        temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            np.savez_compressed(file, key=np.array(key), **arrays)  # type: ignore[arg-type]
        temporary.replace(path)
        return _kept(arrays)

    def scores(self, method: str, sequence: str, key: str) -> list[FrameScore] | None:
        """The rows that `write_scores` was given under this key."""
        rows = self._json(self._path(method, sequence, "scores.json"), key)
        return None if rows is None else [FrameScore(*row) for row in rows]

    def write_scores(self, method: str, sequence: str, key: str, rows: Sequence[FrameScore]) -> None:
        """Keep rows; floats are written to the last bit."""
        self._write_json(self._path(method, sequence, "scores.json"), key, rows)

    def cost(self, method: str, key: str) -> Cost | None:
        """What `write_cost` was given under this key."""
        values = self._json(self._path(method, "cost", "json"), key)
        return None if values is None else Cost(**values)

    def write_cost(self, method: str, key: str, cost: Cost) -> None:
        """Keep a cost."""
        self._write_json(self._path(method, "cost", "json"), key, dataclasses.asdict(cost))

    def forget(self, keep: Sequence[str]) -> None:
        """Remove the entries of sequences that the set no longer has."""
        names = {f"{sequence}.{end}" for sequence in keep for end in ("npz", "scores.json")} | {"cost.json"}
        for path in self.folder.glob("*/*"):
            if path.name not in names and not path.name.endswith(".tmp"):
                path.unlink()

    def _path(self, method: str, name: str, end: str) -> Path:
        return self.folder / method / f"{name}.{end}"

    def _json(self, path: Path, key: str) -> Any:
        try:
            content = json.loads(path.read_text())
        except (FileNotFoundError, json.JSONDecodeError):
            return None
        return content["value"] if content.get("key") == key else None

    def _write_json(self, path: Path, key: str, value: Any) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
        temporary.write_text(json.dumps({"key": key, "value": value}))
        temporary.replace(path)


def _kept(arrays: Mapping[str, np.ndarray]) -> Prediction:
    """What an entry holds, in its steps."""
    aolp = dequantise_angle(arrays["aolp"]) if "aolp" in arrays else None
    log_variance = torch.from_numpy(arrays["log_variance"].astype(np.float32)) if "log_variance" in arrays else None
    return Prediction(dequantise_fraction(arrays["dolp"]), aolp, log_variance)


def _wrapped(aolp: Tensor) -> Tensor:
    """An angle in [0, pi), whichever of its names it came by."""
    return aolp.remainder(torch.pi)
