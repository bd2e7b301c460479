"""Checkpoints: tensors in NAME.safetensors, and all metadata needed to use them in NAME.json beside it.

The JSON holds one hash over the tensors and the metadata. Loading runs no code from either file. Neither file contains
a date, so equal trainings give equal bytes.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from polarnet.runtime.files import SUMS, check_seal, replaced, sha256

FORMAT = "polarnet-checkpoint-2"
MIN_RATE_HZ, MAX_RATE_HZ = 1e-3, 1e5  # of a training's frames


def save_checkpoint(path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Write `path` (.safetensors) and the .json beside it.

    `metadata` contains at least "network", "config" and "in_channels". The JSON is written last; its hash rejects a
    pair of files from two different saves.
    """
    path = Path(path)
    _check_suffix(path)
    content = save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()})
    plain = {key: value for key, value in {"format": FORMAT, **metadata}.items() if key != "sha256"}
    record = {"format": FORMAT, "sha256": _digest(content, plain), **plain}
    for file, data in ((path, content), (path.with_suffix(".json"), (json.dumps(record, indent=2) + "\n").encode())):
        with replaced(file) as temporary:
            temporary.write_bytes(data)


def load_checkpoint(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Load tensors (on the CPU) and metadata.

    FileNotFoundError if a file of the pair is missing. ValueError if they are not a pair, if a number is not finite, or
    if the folder has a seal that does not vouch for both.
    """
    path = Path(path)
    _check_suffix(path)
    record = path.with_suffix(".json")
    for file in (path, record):
        if not file.is_file():
            raise FileNotFoundError(f"{file} is missing; a checkpoint is NAME.safetensors and NAME.json together")
    if (path.parent / SUMS).exists():
        check_seal(path.parent, [path.name, record.name])
    try:
        metadata = json.loads(record.read_text())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{record} is not JSON: {error}") from None
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        raise ValueError(f"{record}: expected a {FORMAT}, but the file states another format; train the network again")
    content = path.read_bytes()
    if _digest(content, metadata) != metadata.get("sha256"):
        raise ValueError(
            f"{path} is not the file that {record.name} describes, or that has changed; copy or train the pair again"
        )
    if not (isinstance(metadata.get("network"), str) and isinstance(metadata.get("config"), dict)):
        raise ValueError(f"{record}: expected the name of a network and its config; train the network again")
    try:
        tensors = load(content)
    except SafetensorError as error:
        raise ValueError(f"{path} is not a safetensors file: {error}") from None
    for name, tensor in tensors.items():
        if not tensor.isfinite().all():
            raise ValueError(f"{path}: expected finite weights, {name} has NaN or infinity; train the network again")
    return tensors, metadata


def _digest(content: bytes, metadata: Mapping[str, Any]) -> str:
    """SHA-256 of the tensors' file and of the metadata without its hash."""
    plain = json.loads(json.dumps({key: value for key, value in metadata.items() if key != "sha256"}))  # as read back
    return sha256(content, json.dumps(plain, sort_keys=True).encode())


def trained_window_us(metadata: Mapping[str, Any]) -> int | None:
    """Return the length of a training's windows in microseconds; None unless its events were simulated.

    ValueError for a frame rate that no simulation has, or for a value where the record of the training is.
    """
    record = metadata
    for key in ("data", "events_from", "scenes", "synthesize"):
        record = record.get(key, {})
        if not isinstance(record, Mapping):
            raise ValueError(f"{key}: expected a record of the training, got {str(record)[:80]!r}")
    rate_hz = record.get("frame_rate_hz")
    if rate_hz is None:
        return None
    if not isinstance(rate_hz, int | float) or not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise ValueError(f"frame_rate_hz: expected {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g}, got {str(rate_hz)[:80]!r}")
    return round(1e6 / rate_hz)


def load_tensors(network: nn.Module, tensors: Mapping[str, Tensor], path: str | os.PathLike[str]) -> None:
    """Copy the tensors of a file into `network`; ValueError names a missing, surplus or different one."""
    expected, shapes = (
        {name: f"{tuple(tensor.shape)} {tensor.dtype}" for name, tensor in every.items()}
        for every in (network.state_dict(), tensors)
    )
    wrong = sorted(name for name in expected.keys() | shapes.keys() if expected.get(name) != shapes.get(name))
    if wrong:
        raise ValueError(
            f"{path} does not fit the network it is for: {wrong[0]} should be {expected.get(wrong[0], 'absent')}, "
            f"is {shapes.get(wrong[0], 'absent')} ({len(wrong)} tensors differ)"
        )
    network.load_state_dict(tensors)


def _check_suffix(path: Path) -> None:
    if path.suffix != ".safetensors":
        raise ValueError(f"a checkpoint is named by its tensors, NAME.safetensors, got {path}")
