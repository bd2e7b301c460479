"""Ground truth of event sequences: exact frames of intensity, DoLP and AoLP, quantised to 16 bits, in Zarr v3."""

import functools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, Integer, UInt8, UInt16
from torch import Tensor

from polarnet.runtime.arrays import (
    Array,
    as_tensor,
    check_range,
    check_shape,
    floats,
    fractions,
    mask_of,
    whole_numbers,
)
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
    "valid": "whether the truth of a pixel is known, 8 pixels of a row a byte, the leftmost in the highest bit",
}

T = TypeVar("T", bound="SplitStore")


class Frames(NamedTuple):
    """Frames of one sequence."""

    t_us: Int64[Tensor, " n"]
    intensity: Float[Tensor, "n 4 h w"]
    dolp: Float[Tensor, "n h w"]
    aolp: Float[Tensor, "n h w"]
    valid: Bool[Tensor, "n h w"] | None = None
    """Where the truth is known; None: everywhere."""


def quantise_fraction(fraction: Float[Array, "*shape"], name: str = "fraction") -> UInt16[np.ndarray, "*shape"]:
    """Quantise a quantity of [0, 1] to 65535 steps; ValueError outside, beyond float32 rounding error."""
    return (fractions(name, fraction, "...") * FRACTION_STEPS).round().numpy().astype(np.uint16)


def dequantise_fraction(steps: UInt16[np.ndarray, "*shape"]) -> Float[Tensor, "*shape"]:
    """Invert `quantise_fraction`."""
    return torch.from_numpy(steps.astype(np.float32)).div_(FRACTION_STEPS)


def quantise_angle(angle: Float[Array, "*shape"], name: str = "angle") -> UInt16[np.ndarray, "*shape"]:
    """Quantise radians of [0, pi) to 65536 steps round the circle; ValueError outside.

    A value that rounds up to pi becomes 0.
    """
    checked = floats(name, angle, "...")
    check_range(name, checked, 0, math.pi, "radians", "fold them into [0, pi), degrees after torch.deg2rad")
    return ((checked * (ANGLE_STEPS / math.pi)).round().numpy().astype(np.int64) % ANGLE_STEPS).astype(np.uint16)


def dequantise_angle(steps: UInt16[np.ndarray, "*shape"]) -> Float[Tensor, "*shape"]:
    """Invert `quantise_angle`."""
    return torch.from_numpy(steps.astype(np.float32)).mul_(math.pi / ANGLE_STEPS)


def unpack_mask(packed: UInt8[np.ndarray, "*b h bytes"], width: int) -> Bool[Tensor, "*b h w"]:
    """Mask from bytes of 8 pixels of a row each, the leftmost in the highest bit."""
    return torch.from_numpy(np.unpackbits(packed, axis=-1, count=width).astype(bool))


@dataclass(frozen=True)
class Contents:
    """The sequences of a store of scenes or frames, and the values that it is made from.

    >>> from polarnet.storage import Contents
    >>> Contents({"lake-00": "train", "road-00": "test"}, {"seed": 1}).splits["road-00"]
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

    def __post_init__(self):
        for name, split in self.splits.items():
            if split not in SPLITS:
                raise ValueError(f"expected {name} in one of the splits {', '.join(SPLITS)}, got {split!r}")


class SplitStore(Store):
    """A store whose sequences are each in the split train, val or test; a masked one has a column `valid` as well."""

    COLUMNS: ClassVar[Mapping[str, str]]
    splits: dict[str, str]
    """Split of each sequence."""
    variant_of: dict[str, str]
    """Name of the original picture, for each sequence whose scene is a variant."""
    masked: bool
    """Whether the store marks pixels whose light is unknown."""

    @functools.cached_property
    def columns(self) -> Mapping[str, str]:
        """Type of each array of a part, by name."""
        return {name: dtype for name, dtype in self.COLUMNS.items() if self.masked or name != "valid"}

    @classmethod
    def create_split(cls: type[T], path: str | os.PathLike[str], contents: Contents, **metadata: Any) -> T:
        """`create_parts` for these contents."""
        return cls.create_parts(
            path,
            list(contents.splits),
            contents.attributes,
            contents.sequences_per_part,
            splits=dict(contents.splits),
            variant_of=dict(contents.variant_of),
            masked=contents.masked,
            **metadata,
        )

    def of_split(self, split: str) -> list[str]:
        """The sequences of `train`, `val` or `test`, in the store's order; ValueError for another split."""
        if split not in SPLITS:
            raise ValueError(f"expected a split of {', '.join(SPLITS)}, got {split!r}")
        return [name for name in self.sequences if self.splits[name] == split]

    def original_of(self, sequence: str) -> str:
        """The original picture of a sequence or variant; the sequence itself if the store names no pictures."""
        return self.variant_of.get(sequence) or self.attributes.get("scenes", {}).get(sequence, sequence)

    def checked_mask(self, valid: Bool[Array, "*shape"] | None, shape: Sequence[int]) -> Bool[Tensor, "*shape"]:
        """The mask of a masked store, all pixels valid if it is None; ValueError for another shape or store."""
        if valid is None:
            return torch.ones(tuple(shape), dtype=torch.bool)
        if not self.masked:
            raise ValueError(f"{self.path}: got a mask for a store without one; create it with masked=True")
        return mask_of("valid", valid, shape).cpu()


class FrameStore(SplitStore):
    """Frames of sequences, each in the split train, val or test; see `create` and `open`.

    >>> import torch
    >>> from polarnet.storage import Contents, FrameStore
    >>> store = FrameStore.create("frames.zarr", Contents({"lake": "test"}), n_frames=1, height=12, width=18)
    >>> store.write("lake", torch.tensor([0]), torch.full((1, 4, 12, 18), 0.5), *torch.zeros(2, 1, 12, 18))
    >>> store.finish()
    >>> FrameStore.open("frames.zarr").of_split("test")
    ['lake']
    """

    FORMAT = "polarnet.frames"
    VERSION = 6
    COLUMNS: ClassVar[Mapping[str, str]] = {"intensity": "uint16", "dolp": "uint16", "aolp": "uint16", "valid": "uint8"}
    n_frames: int
    """Maximum number of frames of a sequence."""
    height: int
    width: int

    @property
    def chunk(self) -> int:
        """Frames that are compressed together."""
        return min(self.n_frames, FRAMES_PER_CHUNK)

    @classmethod
    def create(
        cls, path: str | os.PathLike[str], contents: Contents, n_frames: int, height: int, width: int
    ) -> "FrameStore":
        """Create a store for up to `n_frames` per sequence, or resume it; see `Store.create_parts`."""
        return cls.create_split(path, contents, n_frames=n_frames, height=height, width=width, conventions=CONVENTIONS)

    def write(
        self,
        sequence: str,
        t_us: Integer[Array, " n"],
        intensity: Float[Array, "n 4 h w"],
        dolp: Float[Array, "n h w"],
        aolp: Float[Array, "n h w"],
        valid: Bool[Array, "n h w"] | None = None,
    ) -> None:
        """Write the frames of the next sequence of a part; a sequence that is already written stays unchanged.

        Arrays may be numpy or torch. TypeError for anything but an array. ValueError for values out of range or not
        finite, integer intensities, wrong shapes, times that do not increase, or a mask in a store without one. A mask
        of None marks all pixels valid.
        """
        t_us = self._checked_times(t_us)
        for name, frames, channels in (("intensity", intensity, "4 "), ("dolp", dolp, ""), ("aolp", aolp, "")):
            check_shape(name, as_tensor(name, frames), f"{len(t_us)} {channels}{self.height} {self.width}")
        known = self.checked_mask(valid, dolp.shape)
        columns = {
            "intensity": quantise_fraction(intensity, "intensity"),
            "dolp": quantise_fraction(dolp, "dolp"),
            "aolp": quantise_angle(aolp, "aolp"),
            "valid": np.packbits(known.numpy(), axis=-1),
        }
        if not self.is_written(sequence):
            self.append(sequence, columns, {"t_us": t_us.tolist()})

    def t_us(self, sequence: str) -> Int64[Tensor, " n"]:
        """Times of a sequence's frames, in microseconds from its start."""
        return torch.tensor(self.record(sequence)["t_us"], dtype=torch.int64)

    def intensity(self, sequence: str) -> Float[Tensor, "n 4 h w"]:
        """Intensities behind the polarizers at 0, 45, 90 and 135 degrees."""
        return dequantise_fraction(self.read_column("intensity", sequence))

    def dolp(self, sequence: str) -> Float[Tensor, "n h w"]:
        """Degree of linear polarization, [0, 1]."""
        return dequantise_fraction(self.read_column("dolp", sequence))

    def aolp(self, sequence: str) -> Float[Tensor, "n h w"]:
        """Angle of linear polarization in radians, [0, pi)."""
        return dequantise_angle(self.read_column("aolp", sequence))

    def valid(self, sequence: str) -> Bool[Tensor, "n h w"] | None:
        """Where the truth is known; None: everywhere."""
        return unpack_mask(self.read_column("valid", sequence), self.width) if self.masked else None

    def frames(self, sequence: str, start: int = 0, stop: int | None = None) -> Frames:
        """Frames of a sequence from number `start` up to `stop` (None: the end)."""
        values = self.read_columns(sequence, [(name, start, stop) for name in self.columns])
        intensity, dolp, aolp, *packed = values
        return Frames(
            self.t_us(sequence)[start:stop],
            dequantise_fraction(intensity),
            dequantise_fraction(dolp),
            dequantise_angle(aolp),
            unpack_mask(packed[0], self.width) if packed else None,
        )

    def _checked_times(self, t_us: Integer[Array, " n"]) -> Int64[Tensor, " n"]:
        times = whole_numbers("t_us", t_us)
        if times.ndim != 1 or not 0 < len(times) <= self.n_frames or (times < 0).any() or (times.diff() <= 0).any():
            raise ValueError(
                f"expected 1 to {self.n_frames} frame times, increasing from 0 or later, got {times.tolist()[:40]}"
            )
        return times
