"""What is trained on what: the parts of a training that differ from one network to another, and its data."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from polarnet import __version__
from polarnet.events.frames import FrameStore
from polarnet.events.representations import Encode
from polarnet.events.store import EventStore
from polarnet.events.windows import EventSource, WindowDataset
from polarnet.lpips import NO_RECORD, stored_record
from polarnet.runtime import precision_on, seed_for
from polarnet.similarity import Lpips
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.fly import EmulatedEvents
from polarnet.simulation.scenes import SceneStore
from polarnet.training.losses import FrameLoss
from polarnet.training.sequences import Batch

BLOCK = 2**20  # bytes

State = list[Tensor] | None
Network = TypeVar("Network", bound=nn.Module)


@dataclass(frozen=True)
class Task:
    """What differs between one network's training and another's."""

    network: nn.Module
    encode: Encode
    """One polarizer's events in a window, as the network wants them."""
    streams: Callable[
        [Batch], tuple[Float[Tensor, "t b c h w"], Float[Tensor, "t b *k h w"], Bool[Tensor, "t b h w"] | None]
    ]
    """What the network gets of a batch, what it should say, and where that is known (None: everywhere)."""
    unroll: Callable[[Tensor, State], tuple[Float[Tensor, "t b *k h w"], State]]
    """What it says for windows in a row, k maps or one alone, and its state after them."""
    loss: FrameLoss
    description: Mapping[str, Any]
    """What a checkpoint says of the network and its input: at least "network", "config" and "in_channels"."""
    wants_intensity: bool = True
    """Whether `streams` looks at the intensity; where it does not, sequences in memory are without."""
    optimizer: str = "adam"
    """A key of OPTIMIZERS."""
    scored: Callable[[Tensor], Float[Tensor, "t b h w"]] = lambda frames: frames
    """Of what it says and should say, the frames that validation scores, and by which the best epoch is chosen."""
    expects: nn.Module | None = None
    """The part of the network that says how large it expects the errors of `scored` to be, whose input has a pixel for
    2 x 2 of the image; None: there is none. A network that has one can `expect(weight, bias)`."""


class Split(NamedTuple):
    """Sequences to learn from, and others to see how well it goes."""

    train: WindowDataset
    val: WindowDataset


def open_events(
    data: str, events: str, scenes: str, emulate: EmulatorConfig, seed: int, threads: int
) -> EventStore | EmulatedEvents:
    """Events as `data` says: `store` reads them, `fly` emulates the scenes in memory; the same to the last bit."""
    if data == "store":
        return EventStore.open(events)
    return EmulatedEvents(SceneStore.open(scenes), emulate, seed, threads)


def open_split(events: EventSource, frames: str, encode: Encode) -> Split:
    """The training and the validation sequences of the stores; ValueError where either split is empty."""
    frame_store = FrameStore.open(frames)
    names = {split: frame_store.of_split(split) for split in Split._fields}
    for split, sequences in names.items():
        if not sequences:
            raise ValueError(
                f"{frames} has no sequence in split {split!r}; ingest more pictures or change the fractions"
            )
    return Split(**{s: WindowDataset(events, frame_store, sequences, encode) for s, sequences in names.items()})


def initialised(build: Callable[[], Network], seed: int) -> Network:
    """A new network whose weights depend on the seed alone, not on what else has drawn random numbers."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_for(seed, "network", "initial weights"))
        return build()


def lpips_of(folder: str, backbone: str, weight: float) -> Lpips | None:
    """The LPIPS network of a loss, from what stage `weights` left in `folder`; None where its weight is 0.

    ValueError where the stage left none of this backbone.
    """
    return Lpips.load(folder, "loss", backbone) if weight > 0 else None


def describe(task: Task, split: Split, config: Any, weights: Path, seed: int, device: torch.device) -> dict[str, Any]:
    """All that decides the weights: what the JSON of a checkpoint says, and what the running checkpoint is keyed by.

    `training.precision` is the one that is used on `device`, `training.optimizer` the one that the network gets.
    """
    events, frames = split.train.events, split.train.frames
    lpips = stored_record(weights, "loss") if any("lpips" in term for term in task.loss.weights) else NO_RECORD
    return {
        **task.description,
        "training": {
            "seed": seed,
            **asdict(config),
            "optimizer": task.optimizer,
            "precision": precision_on(device, config.precision),
        },
        "loss": dict(task.loss.weights),
        "lpips": {key: lpips[key] for key in ("backbone", "sha256")},
        "data": {
            "train_sequences": len(split.train),
            "val_sequences": len(split.val),
            "height": events.height,
            "width": events.width,
            "events_from": events.attributes,
            "events_sha256": content_hash(events.path),  # on the fly: of the scenes that they are made from
            "frames_sha256": content_hash(frames.path),
        },
        "versions": {"polarnet": __version__, "torch": torch.__version__},
    }


def content_hash(path: str) -> str:
    """sha256 over the names and bytes of everything at `path`; of the address alone where it is not on this machine."""
    digest = hashlib.sha256()
    if not Path(path).exists():
        digest.update(path.encode())
    for file in sorted(file for file in [Path(path), *Path(path).rglob("*")] if file.is_file()):
        digest.update(f"{file.relative_to(path)}\0{file.stat().st_size}\0".encode())
        with file.open("rb") as content:
            while block := content.read(BLOCK):
                digest.update(block)
    return digest.hexdigest()
