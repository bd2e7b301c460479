"""Scenes on disk: the polarization of each picture, and the motion of the sensor over it in each sequence, in Zarr v3.

Rendering starts from the stored, quantised scene, so that truth and events agree to the last bit.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from polarnet.runtime.arrays import Array, as_tensor, check_same_shape, check_shape, mask_of
from polarnet.storage.frames import (
    SplitStore,
    dequantise_angle,
    dequantise_fraction,
    quantise_angle,
    quantise_fraction,
    split_columns,
)
from polarnet.storage.parts import Column, Columns, Header

CHUNK = 2**18  # pixels

CONVENTIONS = {
    "s0": "intensity of a picture, row by row: value / 65535",
    "dolp": "degree of linear polarization: value / 65535",
    "aolp": "angle of linear polarization in radians, [0, pi): value * pi / 65536",
    "picture_size": "height and width of a picture in pixels",
    "trajectory": "how the window of a sequence moves: numbers named by the attribute trajectory",
    "duration_us": "length of a sequence in microseconds",
}

MASK_CONVENTION = "1 where the light of a pixel is known, 0 where saturation hid it"


class SceneRecord(NamedTuple):
    """One sequence, ready to be rendered."""

    name: str
    scene: str
    """Name of the scene; several sequences may show one."""
    split: str
    s0: Float[Tensor, "h w"]
    dolp: Float[Tensor, "h w"]
    aolp: Float[Tensor, "h w"]
    trajectory: Float64[Tensor, " k"]
    duration_us: int
    valid: Bool[Tensor, "h w"] | None = None
    """Where the light is known; None: everywhere."""


class Scene(NamedTuple):
    """Polarization over an area larger than the sensor."""

    s0: Float[Tensor, "h w"]
    dolp: Float[Tensor, "h w"]
    aolp: Float[Tensor, "h w"]
    valid: Bool[Tensor, "h w"] | None = None
    """Where the light is known; None: everywhere."""


class SceneStore(SplitStore):
    """Pictures in polarization and the sequences that move over them; see `create` and `open`.

    A part holds the pictures of its sequences, each once.
    """

    FORMAT = "polarnet.scenes"
    VERSION = 3

    def __init__(self, path: str, header: Header):
        super().__init__(path, header)
        self.scene_of: dict[str, str] = dict(zip(self.sequences, header["scene_of_sequence"], strict=True))
        self.sensor_height: int = header["sensor_height"]
        self.sensor_width: int = header["sensor_width"]
        self.trajectory_names: list[str] = header["trajectory"]
        self.masked: bool = header["masked"]
        """Whether the store marks pixels whose light is unknown."""

    @classmethod
    def columns_of(cls, header: Header) -> Columns:
        """Planes of the pictures; the mask only where some pixels are masked."""
        types = {"s0": "uint16", "dolp": "uint16", "aolp": "uint16", **({"valid": "uint8"} if header["masked"] else {})}
        return {name: Column("pixels", dtype, CHUNK) for name, dtype in types.items()}

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        scene_of: Mapping[str, str],
        splits: Mapping[str, str],
        *,
        largest_picture: tuple[int, int],
        sensor: tuple[int, int],
        trajectory_names: Sequence[str],
        attributes: Mapping[str, Any],
        variant_of: Mapping[str, str] | None = None,
        masked: bool = False,
        sequences_per_part: int = 1,
    ) -> "SceneStore":
        """Create a store to write; it lies at PATH.tmp until it is finished.

        `scene_of` maps each sequence to the name of its scene, `splits` each sequence to train, val or test, and
        `variant_of` each sequence over a variant to the name of the variant's picture. ValueError if two sequences of
        one picture or its variants are in different splits. `largest_picture` and `sensor` are (height, width) in
        pixels. A `masked` store records which pixels have known light. Resumes as `EventStore.create` does.
        """
        sequences = list(scene_of)
        columns = split_columns(sequences, splits, variant_of or {})
        _check_no_leak({**scene_of, **(variant_of or {})}, splits)
        metadata = {
            "scene_of_sequence": [scene_of[sequence] for sequence in sequences],
            **columns,
            "largest_picture": list(largest_picture),
            "sensor_height": sensor[0],
            "sensor_width": sensor[1],
            "trajectory": list(trajectory_names),
            "masked": masked,
            "conventions": {**CONVENTIONS, "valid": MASK_CONVENTION} if masked else CONVENTIONS,
        }
        return cls.create_parts(path, sequences, attributes, sequences_per_part, **metadata)

    def write(self, sequence: str, scene: Scene, trajectory: Float64[Array, " k"], duration_us: int) -> None:
        """Write the scene and the trajectory of the next sequence of a part; see `Store.append`.

        A sequence that is already written stays unchanged. Sequences of one picture share its pixels in a part.

        Arrays may be numpy or torch. TypeError for anything but an array. ValueError for values out of range or not
        finite, integers, planes of different shapes, a picture of an impossible size, or a mask in a store without one.
        """
        names, trajectory = self.trajectory_names, as_tensor("trajectory", trajectory)
        if len(trajectory) != len(names) or not trajectory.isfinite().all():
            raise ValueError(f"{sequence}: expected {len(names)} finite numbers ({', '.join(names)}), got {trajectory}")
        if duration_us <= 0:
            raise ValueError(f"{sequence}: expected a duration above 0 us, got {duration_us}")
        if self.is_written(sequence):
            return
        record = {
            "trajectory": trajectory.tolist(),
            "duration_us": int(duration_us),
            "picture_size": list(scene.s0.shape),
        }
        columns = {}
        for name, written in self.records_so_far(sequence).items():
            if self.scene_of[name] == self.scene_of[sequence]:
                record["pixels"] = written["pixels"]
        if "pixels" not in record:
            columns = self._pixels(self.scene_of[sequence], scene)
        self.append(sequence, columns, record)

    def read(self, sequence: str) -> SceneRecord:
        """Everything about one sequence; ValueError that names the column of damaged data."""
        record, names = self.record(sequence), list(self.columns)
        s0, dolp, aolp, *valid = (
            pixels.reshape(record["picture_size"])
            for pixels in self.read_columns(sequence, [(name, 0, None) for name in names])
        )
        return SceneRecord(
            sequence,
            self.scene_of[sequence],
            self.splits[sequence],
            dequantise_fraction(s0),
            dequantise_fraction(dolp),
            dequantise_angle(aolp),
            torch.tensor(record["trajectory"], dtype=torch.float64),
            record["duration_us"],
            torch.from_numpy(valid[0] == 1) if valid else None,
        )

    def duration_us(self, sequence: str) -> int:
        """Length of a sequence in microseconds."""
        return self.record(sequence)["duration_us"]

    def _pixels(self, picture: str, scene: Scene) -> dict[str, np.ndarray]:
        """The columns of a picture; ValueError for a scene that the store cannot hold."""
        planes = {name: as_tensor(name, getattr(scene, name)) for name in ("s0", "dolp", "aolp")}
        for name, plane in planes.items():
            check_shape(name, plane, "height width")
        check_same_shape(planes)
        size, valid = tuple(scene.s0.shape), scene.valid
        if valid is not None and (not self.masked or valid.shape != size):
            raise ValueError(
                f"{picture}: expected a mask of {size} in a store created with masked=True, "
                f"got one of {tuple(valid.shape)}, masked={self.masked}"
            )
        height, width = self.header["largest_picture"]
        if not (self.sensor_height <= size[0] <= height and self.sensor_width <= size[1] <= width):
            raise ValueError(
                f"{picture}: expected a picture between the sensor's {self.sensor_height}x{self.sensor_width} px and "
                f"{height}x{width} px, got {size[0]}x{size[1]}"
            )
        rows = _quantised(scene)
        if self.masked:
            known = torch.ones(size, dtype=torch.bool) if valid is None else mask_of("valid", valid, size)
            rows["valid"] = known.cpu().numpy().astype(np.uint8)
        return {name: values.ravel() for name, values in rows.items()}


def as_stored(scene: Scene) -> Scene:
    """The scene as a store gives it back, quantised."""
    steps = _quantised(scene)
    s0, dolp, aolp = (
        dequantise_fraction(steps["s0"]),
        dequantise_fraction(steps["dolp"]),
        dequantise_angle(steps["aolp"]),
    )
    return Scene(s0, dolp, aolp, scene.valid)


def _quantised(scene: Scene) -> dict[str, np.ndarray]:
    return {
        "s0": quantise_fraction(scene.s0, "s0"),
        "dolp": quantise_fraction(scene.dolp, "dolp"),
        "aolp": quantise_angle(scene.aolp, "aolp"),
    }


def _check_no_leak(picture_by_sequence: Mapping[str, str], splits: Mapping[str, str]) -> None:
    split_of_picture: dict[str, str] = {}
    for sequence, picture in picture_by_sequence.items():
        if split_of_picture.setdefault(picture, splits[sequence]) != splits[sequence]:
            raise ValueError(
                f"picture {picture} would be in the splits {split_of_picture[picture]} and {splits[sequence]}; "
                "put all sequences of a picture and its variants in one"
            )
