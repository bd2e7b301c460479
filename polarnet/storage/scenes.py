"""Scenes on disk: the polarization of each picture, and the motion of the sensor over it in each sequence, in Zarr v3.

Rendering starts from the stored, quantised scene, so that truth and events agree to the last bit.
"""

import os
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from polarnet.runtime.arrays import Array, as_tensor, check_same_shape, check_shape
from polarnet.storage.frames import (
    Contents,
    SplitStore,
    dequantise_angle,
    dequantise_fraction,
    quantise_angle,
    quantise_fraction,
)

CHUNK = 2**18  # pixels

CONVENTIONS = {
    "s0": "intensity of a scene, row by row: value / 65535",
    "dolp": "degree of linear polarization: value / 65535",
    "aolp": "angle of linear polarization in radians, [0, pi): value * pi / 65536",
    "valid": "1 where the light of a pixel is known, 0 where saturation hid it",
    "picture_size": "height and width of a scene in pixels",
    "trajectory": "how the sensor moves in a sequence: numbers named by the attribute trajectory_names",
    "duration_us": "length of a sequence in microseconds",
}

QUANTISERS = {
    "s0": (quantise_fraction, dequantise_fraction),
    "dolp": (quantise_fraction, dequantise_fraction),
    "aolp": (quantise_angle, dequantise_angle),
}


class SceneRecord(NamedTuple):
    """One sequence, ready to be rendered."""

    name: str
    scene: str
    """Name of the scene; several sequences may show one."""
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
    """Scenes and the sequences that move over them; see `create` and `open`.

    A part holds the scenes of its sequences, each once.

    >>> import numpy as np
    >>> import torch
    >>> from polarnet.storage import Contents, SceneStore
    >>> from polarnet.storage.scenes import Scene
    >>> sizes = {"largest_picture": (12, 18), "sensor": (6, 9), "trajectory_names": ["x"]}
    >>> store = SceneStore.create("scenes.zarr", Contents({"lake-00": "test"}), {"lake-00": "lake"}, **sizes)
    >>> store.write("lake-00", Scene(*torch.zeros(3, 12, 18)), np.zeros(1), duration_us=1_000_000)
    >>> store.finish()
    >>> SceneStore.open("scenes.zarr").read("lake-00").s0.shape
    torch.Size([12, 18])
    """

    FORMAT = "polarnet.scenes"
    VERSION = 6
    COLUMNS: ClassVar[Mapping[str, str]] = {"s0": "uint16", "dolp": "uint16", "aolp": "uint16", "valid": "uint8"}
    scene_of: dict[str, str]
    """Name of the scene of each sequence."""
    largest_picture: list[int]
    """Height and width that no scene exceeds, pixels."""
    sensor_height: int
    sensor_width: int
    trajectory_names: list[str]

    @property
    def chunk(self) -> int:
        """Pixels that are compressed together."""
        return CHUNK

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        contents: Contents,
        scene_of: Mapping[str, str],
        *,
        largest_picture: tuple[int, int],
        sensor: tuple[int, int],
        trajectory_names: Sequence[str],
    ) -> "SceneStore":
        """Create a store to write, or resume it; see `Store.create_parts`.

        `scene_of` maps each sequence to the name of its scene. `largest_picture` and `sensor` are (height, width) in
        pixels. ValueError if two sequences of one picture or its variants are in different splits.
        """
        if scene_of.keys() != contents.splits.keys():
            raise ValueError(
                f"expected a scene for each of {len(contents.splits)} sequences, got {len(scene_of)} scenes"
            )
        _check_no_leak({**scene_of, **contents.variant_of}, contents.splits)
        return cls.create_split(
            path,
            contents,
            scene_of=dict(scene_of),
            largest_picture=list(largest_picture),
            sensor_height=sensor[0],
            sensor_width=sensor[1],
            trajectory_names=list(trajectory_names),
            conventions=CONVENTIONS,
        )

    def write(self, sequence: str, scene: Scene, trajectory: Float64[Array, " k"], duration_us: int) -> None:
        """Write the scene and the trajectory of the next sequence of a part; see `Store.append`.

        A sequence that is already written stays unchanged. Sequences over one scene share its pixels in a part.

        Arrays may be numpy or torch. TypeError for anything but an array. ValueError for values out of range or not
        finite, integers, planes of different shapes, a scene of an impossible size, or a mask in a store without one.
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
        name, names = self.scene_of[sequence], self.parts[self.part_of(sequence)]
        same = next((other for other in names[: names.index(sequence)] if self.scene_of[other] == name), None)
        self.append(sequence, {} if same else self._pixels(name, scene), record, rows_of=same)

    def read(self, sequence: str) -> SceneRecord:
        """Scene, trajectory and duration of a sequence; ValueError names the column of damaged data."""
        record, requests = self.record(sequence), [(name, 0, None) for name in self.columns]
        s0, dolp, aolp, *mask = (rows.reshape(record["picture_size"]) for rows in self.read_columns(sequence, requests))
        scene = _dequantised([s0, dolp, aolp], torch.from_numpy(mask[0] == 1) if mask else None)
        trajectory = torch.tensor(record["trajectory"], dtype=torch.float64)
        name, duration_us = self.scene_of[sequence], record["duration_us"]
        return SceneRecord(sequence, name, *scene[:3], trajectory, duration_us, scene.valid)

    def duration_us(self, sequence: str) -> int:
        """Length of a sequence in microseconds."""
        return self.record(sequence)["duration_us"]

    def _pixels(self, name: str, scene: Scene) -> dict[str, np.ndarray]:
        """The columns of a scene; ValueError for a scene that the store cannot hold."""
        planes = {plane: as_tensor(plane, getattr(scene, plane)) for plane in QUANTISERS}
        for plane, values in planes.items():
            check_shape(plane, values, "height width")
        check_same_shape(planes)
        size = tuple(scene.s0.shape)
        height, width = self.largest_picture
        if not (self.sensor_height <= size[0] <= height and self.sensor_width <= size[1] <= width):
            raise ValueError(
                f"{name}: expected a picture between the sensor's {self.sensor_height}x{self.sensor_width} px and "
                f"{height}x{width} px, got {size[0]}x{size[1]}"
            )
        columns = dict(zip(QUANTISERS, _quantised(scene), strict=True))
        columns["valid"] = self.checked_mask(scene.valid, size).numpy().astype(np.uint8)
        return {column: values.ravel() for column, values in columns.items()}


def as_stored(scene: Scene) -> Scene:
    """The scene as a store gives it back, quantised."""
    return _dequantised(_quantised(scene), scene.valid)


def _quantised(scene: Scene) -> list[np.ndarray]:
    return [quantise(getattr(scene, plane), plane) for plane, (quantise, _) in QUANTISERS.items()]


def _dequantised(planes: Sequence[np.ndarray], valid: Tensor | None) -> Scene:
    s0, dolp, aolp = (dequantise(steps) for steps, (_, dequantise) in zip(planes, QUANTISERS.values(), strict=True))
    return Scene(s0, dolp, aolp, valid)


def _check_no_leak(pictures: Mapping[str, str], splits: Mapping[str, str]) -> None:
    split_of: dict[str, str] = {}
    for sequence, picture in pictures.items():
        if split_of.setdefault(picture, splits[sequence]) != splits[sequence]:
            raise ValueError(
                f"picture {picture} would be in the splits {split_of[picture]} and {splits[sequence]}; "
                "put all sequences of a picture and its variants in one"
            )
