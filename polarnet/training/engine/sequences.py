"""Sequences of stored events with their truth, cut into encoded windows, and batches of them.

Batches are augmented; the seed alone determines them.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from typing import Annotated, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int8
from pydantic import Field, PositiveInt
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from polarnet.events.representations import Encode
from polarnet.events.streaming import encode_windows
from polarnet.runtime.machine import generator_for, memory, memory_handed_back
from polarnet.runtime.sections import section
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore

MEMORY_SHARE = 0.7  # share of the free memory that the sequences of a training may take
EIGHTH_TURN = math.pi / 4  # angle between neighbouring polarizers


class Windows(NamedTuple):
    """Windows of one sequence, or with an axis b those of a batch, with the truth at the end of each."""

    names: list[str]
    inputs: Float[Tensor, "t *b c h w"] | Int8[Tensor, "t *b c h w"]
    """Channel by channel (0, 45, 90, 135 degrees); c is 4 times the images per channel of the representation.

    int8 only in the memory of a training, where that is exact.
    """
    dolp: Float[Tensor, "t *b h w"]
    aolp: Float[Tensor, "t *b h w"]
    intensity: Float[Tensor, "t *b 4 h w"]
    """Empty (t = 0) in the memory of a training that does not need intensities."""
    valid: Bool[Tensor, "t *b h w"] | None = None
    """Where the truth is known; None: everywhere."""


class WindowDataset(Dataset[Windows]):
    """Item i holds all windows of sequence i, encoded on access. Frames give the windows' ends and the truth."""

    def __init__(self, events: EventStore, frames: FrameStore, sequences: list[str], encode: Encode):
        if absent := [name for name in sequences if name not in set(events.sequences) & set(frames.sequences)]:
            raise ValueError(f"{', '.join(absent[:8])}: not both in {events.path} and in {frames.path}")
        if (events.height, events.width) != (frames.height, frames.width):
            raise ValueError(
                f"events are {events.height}x{events.width} px ({events.path}), "
                f"frames {frames.height}x{frames.width} ({frames.path}); write both from the same scenes"
            )
        self.events, self.frames, self.sequences, self.encode = events, frames, sequences, encode

    def __len__(self) -> int:
        return len(self.sequences)

    def __getitem__(self, i: int) -> Windows:
        name = self.sequences[i]
        t_us, intensity, dolp, aolp, valid = self.frames.frames(name)
        inputs = encode_windows(self.events.read(name), t_us, self.encode)
        known = None if valid is None else valid[1:]
        return Windows([name], inputs, dolp[1:], aolp[1:], intensity[1:], known)


class View(NamedTuple):
    """An augmented view of a sequence: some windows, rows and columns, maybe mirrored, with renumbered polarizers.

    Polarizer j of the view is polarizer (turn + direction * j) mod 4 of the sequence: the polarizers are rotated by
    turn * 45 degrees against the scene, in reverse order if direction is -1. DoLP does not change.
    """

    windows: slice
    rows: slice
    columns: slice
    mirrored: tuple[int, ...]
    """Axes: -1 and -2."""
    turn: int
    direction: int


def apply_view(sequence: Windows, view: View) -> Windows:
    """Crop, mirror and renumber a sequence. The four channels and their truth stay exact."""

    def cropped(frames: Tensor) -> Tensor:
        return frames[view.windows, ..., view.rows, view.columns].flip(view.mirrored).contiguous()

    polarizers = [(view.turn + view.direction * j) % 4 for j in range(4)]
    inputs = cropped(sequence.inputs).unflatten(1, (4, -1))[:, polarizers].flatten(1, 2)
    aolp = torch.remainder(view.direction * (cropped(sequence.aolp) - view.turn * EIGHTH_TURN), math.pi)
    valid = None if sequence.valid is None else cropped(sequence.valid)
    intensity = cropped(sequence.intensity)[:, polarizers]
    return Windows(sequence.names, inputs, cropped(sequence.dolp), aolp, intensity, valid)


@section
class ViewConfig:
    """Augmentation settings; keys of `train`, `baselines.e2v` and `baselines.e2p` in params.yaml."""

    visits: Annotated[int, Field(gt=0, le=10_000)]
    """Visits to each sequence per epoch, each with a new random view."""
    windows: PositiveInt | None
    """Consecutive windows per visit, starting at a random window; null: all windows."""
    crop: list[Annotated[int, Field(ge=16)]] | None
    """Height and width in pixels of a visit's random crop; null: the whole image."""
    symmetries: bool
    """Mirror the image and renumber the polarizers at random. This does not change DoLP."""

    def __post_init__(self):
        if self.crop is not None and len(self.crop) != 2:
            raise ValueError(f"crop: expected height and width, or null, got {self.crop}")


def random_view(count: int, height: int, width: int, config: ViewConfig, generator: np.random.Generator) -> View:
    """Draw a view of a sequence of `count` windows; ValueError if the sequence is smaller than the view."""
    windows, (rows, columns) = config.windows or count, config.crop or (height, width)
    if windows > count or rows > height or columns > width:
        raise ValueError(
            f"windows, crop: expected at most the {count} windows of {height}x{width} pixels of the sequences, "
            f"got {windows} of {rows}x{columns}"
        )
    start, top, left = generator.integers([count - windows + 1, height - rows + 1, width - columns + 1]).tolist()
    mirror_x, mirror_y, turn, reverse = generator.integers([2, 2, 4, 2]).tolist() if config.symmetries else [0, 0, 0, 0]
    mirrored = tuple(axis for axis, mirror in ((-1, mirror_x), (-2, mirror_y)) if mirror)
    cut = slice(start, start + windows), slice(top, top + rows), slice(left, left + columns)
    return View(*cut, mirrored, turn, -1 if reverse else 1)


class Visits(Dataset[Windows]):
    """All visits of one epoch. Seed, epoch, sequence name and visit number determine the view of each visit."""

    def __init__(self, sequences: WindowDataset | list[Windows], config: ViewConfig, seed: int, epoch: int):
        self.sequences, self.config, self.seed, self.epoch = sequences, config, seed, epoch

    def __len__(self) -> int:
        return self.config.visits * len(self.sequences)

    def order(self) -> list[int]:
        """Return the random order of the visits."""
        generator = generator_for(self.seed, "all sequences", f"order of epoch {self.epoch}")
        return generator.permutation(len(self)).tolist()

    def __getitem__(self, index: int) -> Windows:
        visit, number = divmod(index, len(self.sequences))
        sequence = self.sequences[number]
        count, height, width = sequence.dolp.shape
        generator = generator_for(self.seed, sequence.names[0], f"visit {visit} in epoch {self.epoch}")
        return apply_view(sequence, random_view(count, height, width, self.config, generator))


def loaded_if_it_fits(dataset: WindowDataset, intensity: bool, workers: int) -> list[Windows] | None:
    """A dataset's encoded sequences, if they fit into `MEMORY_SHARE` of the free memory; None if they do not.

    `workers` processes read and encode them; 0 or 1: this process. `intensity` says whether to keep the intensity.
    """
    bytes_each = sum(tensor.nbytes for tensor in packed(dataset[0], intensity)[1:] if tensor is not None)
    if bytes_each * len(dataset) > MEMORY_SHARE * memory()[0]:
        return None
    workers = workers if workers > 1 else 0
    packing = functools.partial(packed, intensity=intensity)
    loader = DataLoader(dataset, batch_size=None, collate_fn=packing, num_workers=workers)

    def own(field: Tensor | None) -> Tensor | None:  # not in the limited memory shared with the worker that read it
        return field.clone() if workers and field is not None else field

    with memory_handed_back():
        return [Windows(names, *map(own, fields)) for names, *fields in loader]  # type: ignore[arg-type]


def packed(sequence: Windows, intensity: bool) -> Windows:
    """Store the inputs as int8 if that is exact, as for most event counts; drop the intensity unless `intensity`."""
    if not intensity:
        sequence = sequence._replace(intensity=sequence.intensity[:0].clone())
    small = sequence.inputs.to(torch.int8)
    return sequence._replace(inputs=small) if torch.equal(small.float(), sequence.inputs) else sequence


def stack(sequences: Sequence[Windows]) -> Windows:
    """Stack sequences into a batch; ValueError if their numbers of windows differ."""
    lengths = {len(sequence.dolp) for sequence in sequences}
    if len(lengths) > 1:
        raise ValueError(f"a batch needs sequences with equally many windows, got {sorted(lengths)}; use batch_size=1")
    names, *columns, masks = zip(*sequences, strict=True)
    valid = None if masks[0] is None else torch.stack(masks, dim=1)  # one store: masks for all or none
    inputs, dolp, aolp, intensity = (torch.stack(column, dim=1) for column in columns)
    return Windows([name for (name,) in names], inputs, dolp, aolp, intensity, valid)


def batches_of(dataset: Dataset[Windows], order: Sequence[int], batch_size: int, workers: int) -> Iterator[Windows]:
    """Yield batches of the sequences in `order`; the last batch may be smaller. Workers, if any, read ahead."""
    return iter(DataLoader(dataset, batch_size, sampler=order, collate_fn=stack, num_workers=workers))
