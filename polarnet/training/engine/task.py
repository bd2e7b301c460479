"""The network-specific parts of a training (`Task`) and its data (`Split`)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, TypeVar

import fsspec
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from polarnet import __version__
from polarnet.events.representations import Encode
from polarnet.metrics.lpips import Lpips, record_of
from polarnet.runtime.files import sha256
from polarnet.runtime.machine import precision_on, seed_for
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.training.engine.losses import Loss
from polarnet.training.engine.sequences import WindowDataset, Windows

State = list[Tensor] | None
Network = TypeVar("Network", bound=nn.Module)


@dataclass(frozen=True)
class Task:
    """The network-specific parts of a training."""

    network: nn.Module
    """One with a module `expected` predicts DoLP, and its error from features (`unroll_with_features`)."""
    encode: Encode
    """Function that turns one channel's events in a window into the network's input."""
    streams: Callable[
        [Windows], tuple[Float[Tensor, "t b c h w"], Float[Tensor, "t b *k h w"], Bool[Tensor, "t b h w"] | None]
    ]
    """Function from a batch to the network's input, the truth, and the mask of known truth (None: all known)."""
    unroll: Callable[[Tensor, State], tuple[Float[Tensor, "t b *k h w"], State]]
    """Function from consecutive windows and a state to k predicted maps (or one, without the axis) and a state."""
    loss: Loss
    description: Mapping[str, Any]
    """Metadata of the network and its input for checkpoints: at least "network", "config" and "in_channels"."""
    wants_intensity: bool = True
    """Whether `streams` reads the intensity. If not, sequences kept in memory leave it out."""
    optimizer: str = "adam"
    """A key of OPTIMIZERS."""
    scored: Callable[[Tensor], Float[Tensor, "t b h w"]] = lambda frames: frames
    """Function that picks the map to score from predicted or true maps; its validation MSE selects the best epoch."""
    scene_dolp: Sequence[float] | None = None
    """Median and 90th percentile of the mean DoLP of real scenes, for which the expected errors are fitted, too. None:
    they are fitted to the training pictures alone."""


@dataclass(frozen=True)
class Baseline:
    """Record of a baseline that the pipeline trains; its module in polarnet.training holds it as `BASELINE`."""

    config: type
    """Class of its section of `baselines` in params.yaml."""
    task: Callable[[Any, Lpips | None, int], Task]
    """Section, LPIPS and seed -> the task of a new network."""
    lpips: tuple[str, ...]
    """Keys of the section that are weights of LPIPS in the loss."""


class Split(NamedTuple):
    """Training and validation sequences."""

    train: WindowDataset
    val: WindowDataset


def open_split(events: EventStore, frames: str, encode: Encode) -> Split:
    """Open the training and validation sequences; ValueError if either split is empty."""
    frame_store = FrameStore.open(frames)
    names = {split: frame_store.of_split(split) for split in Split._fields}
    for split, sequences in names.items():
        if not sequences:
            raise ValueError(f"{frames} has no sequence in split {split!r}; ingest more pictures or change fractions")
    return Split(**{s: WindowDataset(events, frame_store, sequences, encode) for s, sequences in names.items()})


def initialised(build: Callable[[], Network], seed: int) -> Network:
    """Build a network whose initial weights depend only on the seed, not on torch's global random state."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_for(seed, "network", "initial weights"))
        return build()


def describe(task: Task, split: Split, config: Any, backbone: str, seed: int, device: torch.device) -> dict[str, Any]:
    """Collect everything that determines the weights, for a checkpoint's JSON and the running checkpoint's key.

    `backbone` is that of LPIPS, if the loss has it. `training.precision` and `training.optimizer` are those in use on
    `device` and for the network.
    """
    events, frames = split.train.events, split.train.frames
    settings = {name: value for name, value in asdict(config).items() if name != "start"}  # start_sha256 stands for it
    precision = precision_on(device, config.precision)
    lpips = record_of(backbone if any("lpips" in term for term in task.loss.weights) else None)
    return {
        **task.description,
        "training": {"seed": seed, **settings, "optimizer": task.optimizer, "precision": precision},
        "loss": dict(task.loss.weights),
        "lpips": {key: lpips[key] for key in ("backbone", "sha256")},
        "data": {
            "train_sequences": len(split.train),
            "val_sequences": len(split.val),
            "height": events.height,
            "width": events.width,
            "events_from": events.attributes,
            "events_sha256": store_hash(events.path),
            "frames_sha256": store_hash(frames.path),
        },
        "versions": {"polarnet": __version__, "torch": torch.__version__},
    }


def store_hash(path: str) -> str:
    """Return the sha256 of a store's zarr.json, which holds the checksum of each part, on disk or at a URL."""
    with fsspec.open(f"{path}/zarr.json") as file:
        return sha256(file.read())
