"""What a training step sees: sequences, augmented and stacked into batches, the same in every run with one seed."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import psutil
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from polarnet.events.windows import WindowDataset, WindowSequence
from polarnet.ranges import allowed, check_ranges
from polarnet.runtime import generator_for, memory_handed_back

Sequences = WindowDataset | list[WindowSequence]

KEPT = 0.7  # of the memory that is free when a training begins, for its sequences
EIGHTH_TURN = math.pi / 4  # between neighbouring polarizers


class Batch(NamedTuple):
    """b sequences of t windows each. c counts the input's channels, polarizer by polarizer."""

    names: list[str]
    inputs: Float[Tensor, "t b c h w"]
    dolp: Float[Tensor, "t b h w"]
    aolp: Float[Tensor, "t b h w"]
    intensity: Float[Tensor, "t b 4 h w"]
    valid: Bool[Tensor, "t b h w"] | None = None
    """Where the truth is known; None: everywhere."""


class View(NamedTuple):
    """Some windows, a part of the image, perhaps mirrored, through polarizers that are numbered differently.

    Polarizer j of the view is polarizer (turn + direction * j) mod 4 of the sequence: the sensor's polarizers turned by
    turn * 45 degrees against the scene, and counted the other way round where direction is -1. DoLP does not change.
    """

    start: int
    windows: int
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
    stop, bottom, right = view.start + view.windows, view.top + view.height, view.left + view.width
    mirrored = [axis for axis, mirror in ((-1, view.mirror_x), (-2, view.mirror_y)) if mirror]

    def look(frames: Tensor) -> Tensor:
        return frames[view.start : stop, ..., view.top : bottom, view.left : right].flip(mirrored).contiguous()

    polarizers = [(view.turn + view.direction * j) % 4 for j in range(4)]
    inputs = look(sequence.inputs).unflatten(1, (4, -1))[:, polarizers].flatten(1, 2).float()
    aolp = view.direction * (look(sequence.aolp) - view.turn * EIGHTH_TURN)
    intensity = look(sequence.intensity)[:, polarizers]
    valid = None if sequence.valid is None else look(sequence.valid)
    return WindowSequence(sequence.name, inputs, look(sequence.dolp), torch.remainder(aolp, math.pi), intensity, valid)


@dataclass(frozen=True)
class ViewConfig:
    """How a training looks at its sequences; keys of `train`, `baselines.e2v` and `baselines.e2p` in params.yaml."""

    visits: int = field(metadata=allowed(low=1))
    """To each sequence in an epoch, each with another view."""
    windows: int | None = field(metadata=allowed(low=1))
    """In a row that a visit sees, beginning anywhere; null: all."""
    crop: list[int] | None = field(metadata=allowed(low=16))
    """Height and width in pixels of the part that a visit sees, anywhere in the image; null: all of it."""
    symmetries: bool
    """Mirror the image and renumber the polarizers at random, which leaves DoLP as it is."""

    def __post_init__(self):
        check_ranges(self)
        if self.crop is not None and len(self.crop) != 2:
            raise ValueError(f"crop: expected height and width, or null, got {self.crop}")


def random_view(count: int, height: int, width: int, config: ViewConfig, generator: np.random.Generator) -> View:
    """A view of a sequence of `count` windows; ValueError where the sequence is smaller than what should be seen."""
    windows, (rows, columns) = config.windows or count, config.crop or (height, width)
    if windows > count or rows > height or columns > width:
        raise ValueError(
            f"windows, crop: expected at most the {count} windows of {height}x{width} pixels of the sequences, "
            f"got {windows} of {rows}x{columns}"
        )
    start, top, left = generator.integers([count - windows + 1, height - rows + 1, width - columns + 1]).tolist()
    mirror_x, mirror_y, turn, reverse = generator.integers([2, 2, 4, 2]).tolist() if config.symmetries else [0, 0, 0, 0]
    direction = -1 if reverse else 1
    return View(start, windows, top, left, rows, columns, bool(mirror_x), bool(mirror_y), turn, direction)


class Visits(Dataset[WindowSequence]):
    """Every visit of an epoch to some sequences, each under a view drawn from the seed, the epoch and their name."""

    def __init__(self, sequences: Sequences, config: ViewConfig, seed: int, epoch: int):
        self.sequences, self.config, self.seed, self.epoch = sequences, config, seed, epoch

    def __len__(self) -> int:
        return self.config.visits * len(self.sequences)

    def __getitem__(self, index: int) -> WindowSequence:
        visit, number = divmod(index, len(self.sequences))
        sequence = self.sequences[number]
        count, height, width = sequence.dolp.shape
        generator = generator_for(self.seed, sequence.name, f"visit {visit} in epoch {self.epoch}")
        return seen(sequence, random_view(count, height, width, self.config, generator))


def kept_in_memory(dataset: WindowDataset, workers: int, intensity: bool) -> tuple[Sequences, int]:
    """The sequences of a dataset, read and encoded beforehand if that takes at most `KEPT` of the free memory.

    Also how many worker processes should read them: none when they are in memory. `intensity`: whether it is wanted.
    """
    bytes_each = sum(tensor.nbytes for tensor in packed(dataset[0], intensity)[1:] if tensor is not None)
    if bytes_each * len(dataset) > KEPT * psutil.virtual_memory().available:
        return dataset, workers
    with memory_handed_back():
        return [packed(dataset[number], intensity) for number in range(len(dataset))], 0


def packed(sequence: WindowSequence, intensity: bool) -> WindowSequence:
    """The sequence with its inputs as bytes where those hold them exactly: counts of events nearly always.

    Without its intensity, the largest part, where that is not wanted.
    """
    if not intensity:
        sequence = sequence._replace(intensity=sequence.intensity[:0].clone())
    small = sequence.inputs.to(torch.int8)
    return sequence._replace(inputs=small) if torch.equal(small.float(), sequence.inputs) else sequence


def stack(sequences: Sequence[WindowSequence]) -> Batch:
    """A batch of sequences with equally many windows; ValueError where they differ."""
    lengths = {len(sequence.dolp) for sequence in sequences}
    if len(lengths) > 1:
        raise ValueError(f"a batch needs sequences with equally many windows, got {sorted(lengths)}; use batch_size=1")
    names, *columns, masks = zip(*sequences, strict=True)
    valid = None if masks[0] is None else torch.stack(masks, dim=1)  # all of one store, which has masks or has none
    inputs, dolp, aolp, intensity = (torch.stack(column, dim=1) for column in columns)
    return Batch(list(names), inputs, dolp, aolp, intensity, valid)


def parts_of(batch: Batch, parts: int) -> list[Batch]:
    """A batch cut into as many parts of nearly equal size, or into single visits where it has fewer."""
    numbers = [part.tolist() for part in torch.arange(len(batch.names)).tensor_split(parts) if len(part)]
    return [_visits_of(batch, part[0], part[-1] + 1) for part in numbers]


def _visits_of(batch: Batch, start: int, stop: int) -> Batch:
    inputs, dolp, aolp, intensity = (tensor[:, start:stop] for tensor in batch[1:5])
    valid = None if batch.valid is None else batch.valid[:, start:stop]
    return Batch(batch.names[start:stop], inputs, dolp, aolp, intensity, valid)


def shuffled(count: int, seed: int, epoch: int) -> list[int]:
    """The order of an epoch."""
    return generator_for(seed, "all sequences", f"order of epoch {epoch}").permutation(count).tolist()


def batches_of(
    dataset: Dataset[WindowSequence], order: Sequence[int], batch_size: int, workers: int
) -> Iterator[Batch]:
    """Batches of the sequences in `order`, the last one perhaps smaller, read ahead by worker processes if any."""
    return iter(DataLoader(dataset, batch_size, sampler=order, collate_fn=stack, num_workers=workers))
