"""Ground truth of event sequences: exact frames of intensity, DoLP and AoLP, quantised to 16 bits, in Zarr v3."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, Integer, Shaped, UInt16
from pydantic import PositiveInt
from torch import Tensor

from polarnet.runtime.arrays import Array, check_range, floats, fractions, mask_of, whole_numbers
from polarnet.runtime.sections import one_of
from polarnet.runtime.splits import SPLITS
from polarnet.storage.parts import Store

FRACTION_STEPS = 2**16 - 1
ANGLE_STEPS = 2**16
FRAMES_PER_CHUNK = 32

CONVENTIONS = {
    "t_us": "microseconds from the start of the sequence, in its record",
    "intensity": "behind polarizers at 0, 45, 90 and 135 degrees (third axis), with I0 + I90 = S0: value / 65535",
    "dolp": "degree of linear polarization: value / 65535",
    "aolp": "angle of linear polarization in radians, [0, pi): value * pi / 65536",
    "valid": "whether the truth of a pixel is known",
}


class Polarization(NamedTuple):
    """S0, DoLP and AoLP over the sensor (a frame) or over a larger area (a scene)."""

    s0: Float[Tensor, "h w"]
    """In [0, 1]."""
    dolp: Float[Tensor, "h w"]
    aolp: Float[Tensor, "h w"]
    """Radians in [0, pi)."""
    valid: Bool[Tensor, "h w"] | None = None
    """Where the light is known; None: everywhere."""


class Frames(NamedTuple):
    """Frames of one sequence."""

    t_us: Int64[Tensor, " n"]
    intensity: Float[Tensor, "n 4 h w"]
    dolp: Float[Tensor, "n h w"]
    aolp: Float[Tensor, "n h w"]
    valid: Bool[Tensor, "n h w"] | None = None
    """Where the truth is known; None: everywhere."""


def quantise(name: str, values: Float[Array, "*shape"], axes: str = "...") -> UInt16[np.ndarray, "*shape"]:
    """Steps of a quantity: 65536 from 0 to pi for the angle `aolp` in radians, 65535 from 0 to 1 for any other.

    ValueError for other axes (see `check_shape`), and outside [0, pi) or [0, 1], beyond float32 rounding error. An
    angle that rounds up to pi becomes 0.
    """
    if name != "aolp":
        return (fractions(name, values, axes) * FRACTION_STEPS).round().numpy().astype(np.uint16)
    angles = floats(name, values, axes)
    check_range(name, angles, 0, math.pi, "radians", "fold them into [0, pi), degrees after torch.deg2rad")
    return ((angles * (ANGLE_STEPS / math.pi)).round().numpy().astype(np.int64) % ANGLE_STEPS).astype(np.uint16)


def dequantise(name: str, steps: Shaped[np.ndarray, "*shape"]) -> Shaped[Tensor, "*shape"]:
    """Invert `quantise`; a mask `valid` stays as it is."""
    if name == "valid":
        return torch.from_numpy(steps)
    values = torch.from_numpy(steps.astype(np.float32))
    return values.mul_(math.pi / ANGLE_STEPS) if name == "aolp" else values.div_(FRACTION_STEPS)


@dataclass(frozen=True)
class Contents:
    """The sequences of a store of scenes or frames, and the values that it is made from.

    >>> from polarnet.storage import Contents
    >>> Contents({"lake": "train", "shore": "test"}).splits["shore"]
    'test'
    """

    splits: Mapping[str, str]
    """Split (train, val or test) of each sequence, in the store's order."""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    """Plain JSON: everything that the sequences depend on."""
    variant_of: Mapping[str, str] = field(default_factory=dict)
    """Name of the original picture, for each sequence whose scene is a variant."""
    masked: bool = False
    """Whether the store marks pixels whose light is unknown."""
    sequences_per_part: int = 1


class SplitStore(Store):
    """A store of `Contents`, whose fields are its attributes; a masked one has a column `valid` as well."""

    splits: dict[str, Annotated[str, one_of(SPLITS)]]
    variant_of: dict[str, str]
    masked: bool

    def of_split(self, split: str) -> list[str]:
        """The sequences of `train`, `val` or `test`, in the store's order; ValueError for another split."""
        if split not in SPLITS:
            raise ValueError(f"expected a split of {', '.join(SPLITS)}, got {split!r}")
        return [name for name in self.sequences if self.splits[name] == split]

    def original_of(self, sequence: str) -> str:
        """The original picture of a sequence or variant; the sequence itself if the store names no pictures."""
        return self.variant_of.get(sequence) or self.attributes.get("scenes", {}).get(sequence, sequence)

    def mask_column(self, valid: Bool[Array, "*shape"] | None, shape: Sequence[int]) -> dict[str, np.ndarray]:
        """The column `valid` of a masked store, True everywhere if the mask is None; no column in another store.

        ValueError for a mask of another shape, or for a store without one.
        """
        if valid is not None and not self.masked:
            raise ValueError(f"{self.path}: got a mask for a store without one; create it with masked=True")
        known = np.ones(tuple(shape), bool) if valid is None else mask_of("valid", valid, shape).cpu().numpy()
        return {"valid": known} if self.masked else {}


class FrameStore(SplitStore):
    """Frames of sequences, each in the split train, val or test; see `create` and `open`.

    >>> import torch
    >>> from polarnet.storage import Contents, FrameStore
    >>> store = FrameStore.create("frames.zarr", Contents({"lake": "test"}), height=12, width=18)
    >>> store.write("lake", torch.tensor([0]), torch.full((1, 4, 12, 18), 0.5), *torch.zeros(2, 1, 12, 18))
    >>> store.finish()
    >>> FrameStore.open("frames.zarr").of_split("test")
    ['lake']
    """

    FORMAT = "polarnet.frames"
    VERSION = 7
    chunk = FRAMES_PER_CHUNK
    height: PositiveInt
    width: PositiveInt

    @classmethod
    def create(cls, path: str | os.PathLike[str], contents: Contents, height: int, width: int) -> "FrameStore":
        """Create a store to write, or resume it; see `Store.create_parts`."""
        return cls.create_parts(
            path, list(contents.splits), **vars(contents), height=height, width=width, conventions=CONVENTIONS
        )

    def write(
        self,
        sequence: str,
        t_us: Integer[Array, " n"],
        intensity: Float[Array, "n 4 h w"],
        dolp: Float[Array, "n h w"],
        aolp: Float[Array, "n h w"],
        valid: Bool[Array, "n h w"] | None = None,
    ) -> None:
        """Write the frames of the next sequence of a part; see `Store.append`.

        Arrays may be numpy or torch. TypeError for anything but an array. ValueError for values out of range or not
        finite, integer intensities, wrong shapes, times that do not increase, or a mask in a store without one. A mask
        of None marks all pixels valid.
        """
        times = whole_numbers("t_us", t_us)
        if times.ndim != 1 or not len(times) or (times < 0).any() or (times.diff() <= 0).any():
            raise ValueError(f"expected frame times that increase from 0 or later, got {times.tolist()[:40]}")
        columns = {}
        for name, values, channels in (("intensity", intensity, "4 "), ("dolp", dolp, ""), ("aolp", aolp, "")):
            columns[name] = quantise(name, values, f"{len(times)} {channels}{self.height} {self.width}")
        columns |= self.mask_column(valid, dolp.shape)
        self.append(sequence, columns, {"t_us": times.tolist()})

    def t_us(self, sequence: str) -> Int64[Tensor, " n"]:
        """Times of a sequence's frames, in microseconds from its start."""
        return torch.tensor(self.record(sequence)["t_us"], dtype=torch.int64)

    def quantity(self, name: str, sequence: str) -> Tensor:
        """`intensity`, `dolp`, `aolp` or, in a masked store, `valid` of all frames of a sequence, as in `Frames`."""
        return dequantise(name, self.read_column(name, sequence))

    def frames(self, sequence: str, start: int = 0, stop: int | None = None) -> Frames:
        """Frames of a sequence from number `start` up to `stop` (None: the end)."""
        names = ["intensity", "dolp", "aolp", *["valid"] * self.masked]
        (columns,) = self.read_columns(sequence, names, [(start, stop)])
        values = {name: dequantise(name, rows) for name, rows in columns.items()}
        return Frames(self.t_us(sequence)[start:stop], **values)
