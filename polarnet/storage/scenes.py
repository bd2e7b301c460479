"""Scenes on disk: the polarization of each picture, and the motion of the sensor over it in each sequence, in Zarr v3.

Rendering starts from the stored, quantised scene, so that truth and events agree to the last bit.
"""

import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from polarnet.runtime.arrays import Array, as_tensor, check_same_shape, check_shape, mask_of
from polarnet.storage.frames import (
    check_splits,
    dequantise_angle,
    dequantise_fraction,
    names_of_split,
    quantise_angle,
    quantise_fraction,
)
from polarnet.storage.table import Column, Columns, Table, check_names, create_table, open_table, refuse_missing

FORMAT = "polarnet.scenes"
VERSION = 1

CONVENTIONS = {
    "s0": "intensity of a picture in the upper left corner of its row: value / 65535",
    "dolp": "degree of linear polarization: value / 65535",
    "aolp": "angle of linear polarization in radians, [0, pi): value * pi / 65536",
    "picture_size": "height and width of a picture in pixels",
    "trajectory": "how the window of a sequence moves: numbers named by the attribute trajectory",
    "duration_us": "length of a sequence in microseconds",
}

_VARIANT = re.compile(r"(.+)-variant[0-9]+")

MASK_CONVENTION = "1 where the light of a pixel is known, 0 where saturation hid it"


def variant_name(picture: str, number: int) -> str:
    """Of a scene that `polarnet.simulation.variation` makes of a picture."""
    return f"{picture}-variant{number:02d}"


def made_from(scene: str) -> str:
    """The picture that a scene is, or a variant of."""
    variant = _VARIANT.fullmatch(scene)
    return variant[1] if variant else scene


def without_variants(sequences: Sequence[str]) -> list[str]:
    """The sequences whose scene is a picture as it is."""
    scenes = {name: name.rpartition("-")[0] for name in sequences}
    return [name for name, scene in scenes.items() if made_from(scene) == scene]


class SceneRecord(NamedTuple):
    """One sequence, ready to be rendered."""

    name: str
    picture: str
    split: str
    s0: Float[Tensor, "h w"]
    dolp: Float[Tensor, "h w"]
    aolp: Float[Tensor, "h w"]
    trajectory: Float64[Tensor, " k"]
    duration_us: int
    valid: Bool[Tensor, "h w"] | None = None
    """Where the light is known; None: everywhere."""


class SceneStore:
    """Pictures in polarization and the sequences that move over them; see `create` and `open`."""

    def __init__(self, table: Table):
        self._table = table
        self.path = table.path
        metadata = table.attributes
        self.sequences: list[str] = list(metadata["sequences"])
        self.picture_of: dict[str, str] = dict(zip(self.sequences, metadata["picture_of_sequence"], strict=True))
        self.splits: dict[str, str] = dict(zip(self.sequences, metadata["splits"], strict=True))
        self.pictures: list[str] = list(metadata["pictures"])
        self.sensor_height: int = metadata["window_height"]
        self.sensor_width: int = metadata["window_width"]
        self.trajectory_names: list[str] = list(metadata["trajectory"])
        self.masked: bool = "valid" in table.columns
        """Whether there may be pixels whose light is not known."""
        self.attributes: dict[str, Any] = metadata["attributes"]
        """What whoever created the store said about it."""

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        picture_of: Mapping[str, str],
        splits: Mapping[str, str],
        *,
        largest_picture: tuple[int, int],
        sensor: tuple[int, int],
        trajectory_names: Sequence[str],
        attributes: Mapping[str, Any],
        masked: bool = False,
    ) -> "SceneStore":
        """A store to write, at PATH.tmp until it is finished, with a row for each sequence and one for each picture.

        `picture_of` maps each sequence to its picture, `splits` each sequence to train, val or test; ValueError where
        two sequences of one picture are in different splits. `largest_picture` and `sensor` are (height, width) in
        pixels. A `masked` store says of every pixel whether its light is known. Resumes as `EventStore.create` does.
        """
        sequences = list(picture_of)
        pictures = sorted(set(picture_of.values()))
        check_names(sequences)
        check_splits(sequences, splits)
        _check_no_leak(picture_of, splits)
        metadata = {
            "sequences": sequences,
            "picture_of_sequence": [picture_of[sequence] for sequence in sequences],
            "splits": [splits[sequence] for sequence in sequences],
            "pictures": pictures,
            "largest_picture": list(largest_picture),
            "window_height": sensor[0],
            "window_width": sensor[1],
            "trajectory": list(trajectory_names),
            "conventions": CONVENTIONS,
            "attributes": dict(attributes),
        }
        if masked:
            metadata |= {"masked": True, "conventions": {**CONVENTIONS, "valid": MASK_CONVENTION}}
        return cls(create_table(path, FORMAT, VERSION, metadata, _columns(metadata)))

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> "SceneStore":
        """A finished store: a local folder, a zip, or an fsspec URL. See `polarnet.storage.table.open_table`."""
        return cls(open_table(path, FORMAT, VERSION, _columns))

    def write_picture(
        self,
        picture: str,
        s0: Float[Array, "h w"],
        dolp: Float[Array, "h w"],
        aolp: Float[Array, "h w"],
        valid: Bool[Array, "h w"] | None = None,
    ) -> None:
        """Put a picture in its row; one that is there already stays as it is. `valid` None: all its light is known.

        Arrays may be numpy or torch. Raises TypeError for what is no array, and ValueError for values out of range or
        not finite, integers, planes of different shapes, a picture of a size that cannot be, or a mask in a store that
        has none.
        """
        planes = {name: as_tensor(name, plane) for name, plane in (("s0", s0), ("dolp", dolp), ("aolp", aolp))}
        for name, plane in planes.items():
            check_shape(name, plane, "height width")
        check_same_shape(planes)
        if valid is not None and (not self.masked or valid.shape != s0.shape):
            raise ValueError(
                f"{picture}: expected a mask of {tuple(s0.shape)} in a store created with masked=True, "
                f"got one of {tuple(valid.shape)}, masked={self.masked}"
            )
        height, width = self._table.columns["s0"].shape
        if not (self.sensor_height <= s0.shape[0] <= height and self.sensor_width <= s0.shape[1] <= width):
            raise ValueError(
                f"{picture}: expected a picture between the sensor's {self.sensor_height}x{self.sensor_width} px and "
                f"{height}x{width} px, got {s0.shape[0]}x{s0.shape[1]}"
            )
        rows = {
            "s0": quantise_fraction(s0, "s0"),
            "dolp": quantise_fraction(dolp, "dolp"),
            "aolp": quantise_angle(aolp, "aolp"),
        }
        if self._table.is_written("picture_size", picture):
            return
        if self.masked:
            known = (
                torch.ones(tuple(s0.shape), dtype=torch.bool) if valid is None else mask_of("valid", valid, s0.shape)
            )
            rows["valid"] = known.cpu().numpy().astype(np.uint8)
        for name, steps in rows.items():
            self._table.write(name, picture, steps)
        self._table.write("picture_size", picture, np.array(s0.shape))

    def write(self, sequence: str, trajectory: Float64[Array, " k"], duration_us: int) -> None:
        """Put the trajectory of a sequence in its row, if it is not there yet; its picture may come before or after."""
        names, trajectory = self.trajectory_names, as_tensor("trajectory", trajectory)
        if len(trajectory) != len(names) or not trajectory.isfinite().all():
            raise ValueError(f"{sequence}: expected {len(names)} finite numbers ({', '.join(names)}), got {trajectory}")
        if duration_us <= 0:
            raise ValueError(f"{sequence}: expected a duration above 0 us, got {duration_us}")
        if self._table.is_written("trajectory", sequence):
            return
        self._table.write("duration_us", sequence, np.array(duration_us))
        self._table.write("trajectory", sequence, trajectory.numpy())

    def missing(self) -> list[str]:
        """Sequences whose trajectory is not written yet."""
        return [sequence for sequence in self.sequences if not self._table.is_written("trajectory", sequence)]

    def missing_pictures(self) -> list[str]:
        """Pictures that are not written yet."""
        return [picture for picture in self.pictures if not self._table.is_written("picture_size", picture)]

    def finish(self) -> None:
        """Mark the store complete and move it from PATH.tmp to PATH; ValueError where anything is missing."""
        refuse_missing(self.path, self.missing() + self.missing_pictures())
        self._table.finish({})

    def of_split(self, split: str) -> list[str]:
        """The sequences of `train`, `val` or `test`, in the store's order."""
        return names_of_split(self.splits, split)

    def read(self, sequence: str) -> SceneRecord:
        """Everything about one sequence; ValueError that names the column of damaged data."""
        trajectory = torch.from_numpy(self._table.read("trajectory", sequence))
        picture = self.picture_of[sequence]
        height, width = self._table.read("picture_size", picture).tolist()
        names = ["s0", "dolp", "aolp", *(["valid"] if self.masked else [])]
        s0, dolp, aolp, *valid = (self._table.read(name, picture, slice(height), slice(width)) for name in names)
        return SceneRecord(
            sequence,
            picture,
            self.splits[sequence],
            dequantise_fraction(s0),
            dequantise_fraction(dolp),
            dequantise_angle(aolp),
            trajectory,
            self.duration_us(sequence),
            torch.from_numpy(valid[0] == 1) if valid else None,
        )

    def duration_us(self, sequence: str) -> int:
        """Length of a sequence in microseconds."""
        return int(self._table.read("duration_us", sequence))

    def problems(self, sequence: str) -> list[str]:
        """Damaged or missing data of a sequence or of its picture: the first found."""
        try:
            self.read(sequence)
        except ValueError as error:
            return [str(error)]
        return []


def verify_scenes(path: str | os.PathLike[str]) -> list[str]:
    """Everything that is wrong with a scene store, each with its sequence or picture and column; empty when whole."""
    try:
        store = SceneStore.open(path)
    except (FileNotFoundError, ValueError) as error:
        return [str(error)]
    problems = [problem for name in store.sequences for problem in store.problems(name)]
    return store._table.metadata_problems() + list(dict.fromkeys(problems))  # a picture has several sequences


def _check_no_leak(picture_of: Mapping[str, str], splits: Mapping[str, str]) -> None:
    split_of_picture: dict[str, str] = {}
    for sequence, picture in picture_of.items():
        if split_of_picture.setdefault(picture, splits[sequence]) != splits[sequence]:
            raise ValueError(
                f"picture {picture} would be in the splits {split_of_picture[picture]} and {splits[sequence]}; "
                "put all sequences of a picture in one"
            )


def _columns(metadata: Mapping[str, Any]) -> Columns:
    size = tuple(metadata["largest_picture"])
    numbers = (len(metadata["trajectory"]),)

    def plane(dtype: str = "uint16") -> Column:
        return Column(metadata["pictures"], size, size, size, dtype, fill=0, fill_is_data=True, shuffle="bitshuffle")

    def row(names: Sequence[str], shape: tuple[int, ...], dtype: str, fill: int | float) -> Column:
        return Column(names, shape, shape, shape, dtype, fill, fill_is_data=False, shuffle="shuffle")

    return {
        "s0": plane(),
        "dolp": plane(),
        "aolp": plane(),
        **({"valid": plane("uint8")} if metadata.get("masked") else {}),
        "picture_size": row(metadata["pictures"], (2,), "int64", -1),
        "duration_us": row(metadata["sequences"], (), "int64", -1),
        "trajectory": row(metadata["sequences"], numbers, "float64", float("nan")),
    }
