"""Ground truth of event sequences: exact frames of intensity, DoLP and AoLP, quantised to 16 bits, in Zarr v3."""

import functools
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

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
from polarnet.storage.groups import Column, Columns
from polarnet.storage.parts import Store

SPLITS = ("train", "val", "test")
FRACTION_STEPS = 2**16 - 1
ANGLE_STEPS = 2**16
FRAMES_PER_CHUNK = 32

CONVENTIONS = {
    "t_us": "microseconds from the start of the sequence",
    "intensity": "behind polarizers at 0, 45, 90 and 135 degrees (third axis), with I0 + I90 = S0: value / 65535",
    "dolp": "degree of linear polarization: value / 65535",
    "aolp": "angle of linear polarization in radians, [0, pi): value * pi / 65536",
}

MASK_CONVENTION = "whether the truth of a pixel is known, 8 pixels of a row a byte, the leftmost in the highest bit"


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


class SplitStore(Store):
    """A store whose sequences are each in the split train, val or test."""

    splits: dict[str, str]
    """Split of each sequence."""
    variant_of: dict[str, str]
    """Name of the original picture, for each sequence whose scene is a variant."""
    masked: bool
    """Whether the store marks pixels whose light is unknown."""

    def of_split(self, split: str) -> list[str]:
        """The sequences of `train`, `val` or `test`, in the store's order; ValueError for another split."""
        if split not in SPLITS:
            raise ValueError(f"expected a split of {', '.join(SPLITS)}, got {split!r}")
        return [name for name in self.sequences if self.splits[name] == split]

    def original_of(self, sequence: str) -> str:
        """The original picture of a sequence or variant; the sequence itself if the store names no pictures."""
        return self.variant_of.get(sequence) or self.attributes.get("scenes", {}).get(sequence, sequence)


class FrameStore(SplitStore):
    """Frames of sequences, each in the split train, val or test; see `create` and `open`.

    >>> import torch
    >>> from polarnet.storage import FrameStore
    >>> store = FrameStore.create("frames.zarr", ["lake"], {"lake": "test"}, 1, height=12, width=18, attributes={})
    >>> store.write("lake", torch.tensor([0]), torch.full((1, 4, 12, 18), 0.5), *torch.zeros(2, 1, 12, 18))
    >>> store.finish()
    >>> FrameStore.open("frames.zarr").of_split("test")
    ['lake']
    """

    FORMAT = "polarnet.frames"
    VERSION = 5
    n_frames: int
    """Maximum number of frames of a sequence."""
    height: int
    width: int

    @functools.cached_property
    def columns(self) -> Columns:
        """Times and images of the frames; in a masked store, masks as well."""
        image, chunk = (self.height, self.width), min(self.n_frames, FRAMES_PER_CHUNK)
        columns = {
            "intensity": Column("frames", "uint16", chunk, (4, *image)),
            "dolp": Column("frames", "uint16", chunk, image),
            "aolp": Column("frames", "uint16", chunk, image),
            "t_us": Column("frames", "int64", chunk),
        }
        mask = {"valid": Column("frames", "uint8", chunk, (self.height, -(-self.width // 8)))}
        return columns | mask if self.masked else columns

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        sequences: Sequence[str],
        splits: Mapping[str, str],
        n_frames: int,
        height: int,
        width: int,
        attributes: Mapping[str, Any],
        masked: bool = False,
        sequences_per_part: int = 1,
        variant_of: Mapping[str, str] | None = None,
    ) -> "FrameStore":
        """Create a store for up to `n_frames` per sequence; it lies at PATH.tmp until it is finished.

        `splits` maps each sequence to train, val or test, and `variant_of` each sequence over a variant to the name of
        the variant's picture. A `masked` store records for every pixel whether its truth is
        known; other stores have no mask. Resumes as `EventStore.create` does.
        """
        return cls.create_parts(
            path,
            sequences,
            attributes,
            sequences_per_part,
            splits=splits_of(sequences, splits),
            variant_of=dict(variant_of or {}),
            n_frames=n_frames,
            height=height,
            width=width,
            masked=masked,
            conventions={**CONVENTIONS, "valid": MASK_CONVENTION} if masked else CONVENTIONS,
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
        """Write the frames of the next sequence of a part; a sequence that is already written stays unchanged.

        Arrays may be numpy or torch. TypeError for anything but an array. ValueError for values out of range or not
        finite, integer intensities, wrong shapes, times that do not increase, or a mask in a store without one. A mask
        of None marks all pixels valid.
        """
        t_us = self._checked_times(t_us)
        for name, frames, channels in (("intensity", intensity, "4 "), ("dolp", dolp, ""), ("aolp", aolp, "")):
            check_shape(name, as_tensor(name, frames), f"{len(t_us)} {channels}{self.height} {self.width}")
        known = self._checked_mask(valid, dolp.shape)
        columns = {
            "t_us": t_us.numpy(),
            "intensity": quantise_fraction(intensity, "intensity"),
            "dolp": quantise_fraction(dolp, "dolp"),
            "aolp": quantise_angle(aolp, "aolp"),
            **({"valid": np.packbits(known.numpy(), axis=-1)} if self.masked else {}),
        }
        if not self.is_written(sequence):
            self.append(sequence, columns, {})

    def t_us(self, sequence: str) -> Int64[Tensor, " n"]:
        """Times of a sequence's frames, in microseconds from its start."""
        return torch.from_numpy(self.read_column("t_us", sequence))

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

    def frames(self, sequence: str) -> Frames:
        """All frames of a sequence."""
        names = ["t_us", "intensity", "dolp", "aolp", *(["valid"] if self.masked else [])]
        t_us, intensity, dolp, aolp, *packed = self.read_columns(sequence, [(name, 0, None) for name in names])
        return Frames(
            torch.from_numpy(t_us),
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

    def _checked_mask(self, valid: Bool[Array, "n h w"] | None, shape: Sequence[int]) -> Bool[Tensor, "n h w"]:
        if valid is None:
            return torch.ones(tuple(shape), dtype=torch.bool)
        if not self.masked:
            raise ValueError(f"{self.path}: got a mask for a store without one; create it with masked=True")
        return mask_of("valid", valid, shape).cpu()


def splits_of(names: Sequence[str], splits: Mapping[str, str]) -> dict[str, str]:
    """Split of each name; ValueError for the first name without one, or with one that is not train, val or test."""
    for name in names:
        if splits.get(name) not in SPLITS:
            raise ValueError(f"expected {name} in one of the splits {', '.join(SPLITS)}, got {splits.get(name)!r}")
    return {name: splits[name] for name in names}
