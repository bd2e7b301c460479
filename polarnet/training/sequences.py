"""What a training step sees: sequences, augmented and stacked into batches, the same in every run with one seed."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from polarnet.events.windows import WindowSequence
from polarnet.runtime import generator_for

EIGHTH_TURN = math.pi / 4  # between neighbouring polarizers


class Batch(NamedTuple):
    """b sequences of t windows each. c counts the input's channels, polarizer by polarizer."""

    names: list[str]
    inputs: Float[Tensor, "t b c h w"]
    dolp: Float[Tensor, "t b h w"]
    aolp: Float[Tensor, "t b h w"]
    intensity: Float[Tensor, "t b 4 h w"]


class View(NamedTuple):
    """A part of the image, perhaps mirrored, through polarizers that are numbered differently.

    Polarizer j of the view is polarizer (turn + direction * j) mod 4 of the sequence: the sensor's polarizers turned by
    turn * 45 degrees against the scene, and counted the other way round where direction is -1. DoLP does not change.
    """

    top: int
    left: int
    height: int
    width: int
    mirror_x: bool
    mirror_y: bool
    turn: int
    direction: int


def seen(sequence: WindowSequence, view: View) -> WindowSequence:
    """The sequence under a view: exactly what the four channels would hold, and its truth."""
    bottom, right = view.top + view.height, view.left + view.width
    mirrored = [axis for axis, mirror in ((-1, view.mirror_x), (-2, view.mirror_y)) if mirror]

    def look(frames: Tensor) -> Tensor:
        return frames[..., view.top : bottom, view.left : right].flip(mirrored).contiguous()

    polarizers = [(view.turn + view.direction * j) % 4 for j in range(4)]
    channels = sequence.inputs.unflatten(1, (4, -1))[:, polarizers].flatten(1, 2)
    aolp = view.direction * (sequence.aolp - view.turn * EIGHTH_TURN)
    return WindowSequence(
        sequence.name,
        look(channels),
        look(sequence.dolp),
        look(torch.remainder(aolp, math.pi)),
        look(sequence.intensity[:, polarizers]),
    )


def random_view(
    height: int, width: int, crop: Sequence[int] | None, symmetries: bool, generator: np.random.Generator
) -> View:
    """A crop of (height, width) pixels anywhere, everything where None; mirrored and turned where `symmetries`."""
    rows, columns = crop or (height, width)
    if rows > height or columns > width:
        raise ValueError(f"crop: expected at most the {height}x{width} pixels of the sequences, got {rows}x{columns}")
    top, left = generator.integers(height - rows + 1), generator.integers(width - columns + 1)
    mirror_x, mirror_y, turn, reverse = generator.integers([2, 2, 4, 2]) if symmetries else (0, 0, 0, 0)
    return View(
        int(top), int(left), rows, columns, bool(mirror_x), bool(mirror_y), int(turn), direction=-1 if reverse else 1
    )


class Views(Dataset[WindowSequence]):
    """The sequences of a dataset, each under a view drawn from the seed, the epoch and its name."""

    def __init__(
        self, dataset: Dataset[WindowSequence], seed: int, epoch: int, crop: Sequence[int] | None, symmetries: bool
    ):
        self.dataset, self.seed, self.epoch, self.crop, self.symmetries = dataset, seed, epoch, crop, symmetries

    def __getitem__(self, index: int) -> WindowSequence:
        """Sequence number `index`."""
        sequence = self.dataset[index]
        generator = generator_for(self.seed, sequence.name, f"view in epoch {self.epoch}")
        height, width = sequence.dolp.shape[-2:]
        return seen(sequence, random_view(height, width, self.crop, self.symmetries, generator))


def stack(sequences: Sequence[WindowSequence]) -> Batch:
    """A batch of sequences with equally many windows; ValueError where they differ."""
    lengths = {len(sequence.dolp) for sequence in sequences}
    if len(lengths) > 1:
        raise ValueError(f"a batch needs sequences with equally many windows, got {sorted(lengths)}; use batch_size=1")
    names, *columns = zip(*sequences, strict=True)
    return Batch(list(names), *(torch.stack(column, dim=1) for column in columns))


def shuffled(count: int, seed: int, epoch: int) -> list[int]:
    """The order of an epoch."""
    return generator_for(seed, "all sequences", f"order of epoch {epoch}").permutation(count).tolist()


def batches_of(
    dataset: Dataset[WindowSequence], order: Sequence[int], batch_size: int, workers: int
) -> Iterator[Batch]:
    """Batches of the sequences in `order`, the last one perhaps smaller, read ahead by worker processes if any."""
    return iter(DataLoader(dataset, batch_size, sampler=order, collate_fn=stack, num_workers=workers))
