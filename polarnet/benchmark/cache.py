"""Cache of predictions and scores on disk: one file of each per method and sequence.

Each entry stores a hash of its inputs and is valid only while that hash matches. A new entry overwrites the old one
of the same method and sequence, so the folder does not grow with every change.
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

from polarnet.benchmark.cost import Cost
from polarnet.benchmark.score import FrameScore
from polarnet.benchmark.sequences import TestSequence
from polarnet.metrics.reliability import HIGHEST, LOWEST
from polarnet.runtime.fingerprint import digest
from polarnet.stokes import Prediction
from polarnet.storage.frames import dequantise_angle, dequantise_fraction, quantise_angle, quantise_fraction

FORMAT = "3"  # part of every hash: raise it when the stored format or `rows.predictions_of` changes


def sequence_digest(sequence: TestSequence) -> str:
    """Hash of a sequence's events, times and truth."""
    parts = [sequence.name, sequence.scene]
    columns = [column for e in sequence.events for column in (e.t, e.x, e.y, e.p)]
    arrays = [*columns, sequence.t_us, sequence.dolp, sequence.aolp, sequence.s0]
    if sequence.valid is not None:
        arrays.append(sequence.valid)
    return digest(*parts, *(np.ascontiguousarray(array.numpy()).tobytes() for array in arrays))


class Cache:
    """Cache entries of one test set under `folder`, which may not exist yet.

    Predictions are quantised like the stored truth (DoLP in steps of 1/65535, AoLP in steps of pi/65536); the
    expected error is float16. Scores use the quantised values, so cached and fresh predictions score the same.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def prediction(self, method: str, sequence: str, key: str) -> Prediction | None:
        """The quantised prediction stored under this key; None if there is none."""
        path = self._path(method, sequence, "npz")
        try:
            with np.load(path, allow_pickle=False) as arrays:
                if str(arrays["key"]) != key:
                    return None
                return _kept(arrays)
        except (FileNotFoundError, KeyError, ValueError, EOFError, zipfile.BadZipFile):  # missing or truncated
            return None

    def write_prediction(self, method: str, sequence: str, key: str, prediction: Prediction) -> Prediction:
        """Store a prediction (DoLP in [0, 1], AoLP in radians) and return it quantised.

        ValueError, naming the method and the window, if a value is not finite.
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
        """The scores stored under this key; None if there are none."""
        rows = self._json(self._path(method, sequence, "scores.json"), key)
        return None if rows is None else [FrameScore(*row) for row in rows]

    def write_scores(self, method: str, sequence: str, key: str, rows: Sequence[FrameScore]) -> None:
        """Store scores; floats keep every bit."""
        self._write_json(self._path(method, sequence, "scores.json"), key, rows)

    def cost(self, method: str, key: str) -> Cost | None:
        """The cost stored under this key; None if there is none."""
        values = self._json(self._path(method, "cost", "json"), key)
        return None if values is None else Cost(**values)

    def write_cost(self, method: str, key: str, cost: Cost) -> None:
        """Store a cost."""
        self._write_json(self._path(method, "cost", "json"), key, dataclasses.asdict(cost))

    def forget(self, keep: Sequence[str]) -> None:
        """Remove the entries of sequences that are not in `keep`."""
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
    """Prediction from the quantised arrays of an entry."""
    aolp = dequantise_angle(arrays["aolp"]) if "aolp" in arrays else None
    log_variance = torch.from_numpy(arrays["log_variance"].astype(np.float32)) if "log_variance" in arrays else None
    return Prediction(dequantise_fraction(arrays["dolp"]), aolp, log_variance)


def _wrapped(aolp: Tensor) -> Tensor:
    """AoLP wrapped to [0, pi)."""
    return aolp.remainder(torch.pi)
