"""Scenes on disk: the polarization of each picture, and the motion of the sensor over it in each sequence, in Zarr v3.

Rendering starts from the stored, quantised scene, so that truth and events agree to the last bit.
"""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import PositiveInt

from polarnet.runtime.arrays import as_tensor, check_same_shape
from polarnet.storage.frames import Contents, Polarization, SplitStore, dequantise, quantise

PLANES = ("s0", "dolp", "aolp")
CONVENTIONS = {
    "s0": "intensity of a scene, row by row: value / 65535",
    "dolp": "degree of linear polarization: value / 65535",
    "aolp": "angle of linear polarization in radians, [0, pi): value * pi / 65536",
    "valid": "whether the light of a pixel is known; saturation hides it",
    "picture_size": "height and width of a scene in pixels",
    "trajectory": "how the sensor moves in a sequence, as polarnet.simulation.motion.Trajectory",
    "duration_us": "length of a sequence in microseconds",
    "dynamic_range": "brightest over darkest light of a scene whose s0 is logarithmic; missing: s0 is the light itself",
}


class SceneStore(SplitStore):
    """The scene of each sequence, and how the sensor moves over it; see `create` and `open`.

    >>> import torch
    >>> from polarnet.storage import Contents, SceneStore
    >>> from polarnet.storage.frames import Polarization
    >>> store = SceneStore.create("scenes.zarr", Contents({"lake-00": "test"}), {"lake-00": "lake"}, (6, 9))
    >>> store.write("lake-00", Polarization(*torch.zeros(3, 12, 18)), {"x": 8.5, "y": 5.5}, duration_us=1_000_000)
    >>> store.finish()
    >>> SceneStore.open("scenes.zarr").read("lake-00").s0.shape
    torch.Size([12, 18])
    """

    FORMAT = "polarnet.scenes"
    VERSION = 8
    chunk = 2**18  # pixels
    scene_of: dict[str, str]
    """Name of the scene of each sequence; several sequences may show one."""
    sensor_height: PositiveInt
    sensor_width: PositiveInt

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        contents: Contents,
        scene_of: Mapping[str, str],
        sensor: tuple[int, int],
    ) -> "SceneStore":
        """Create a store to write, or resume it; see `Store.create_parts`.

        `scene_of` maps each sequence to the name of its scene. `sensor` is (height, width) in pixels. ValueError if two
        sequences of one picture or its variants are in different splits.
        """
        split_of: dict[str, str] = {}
        for sequence, picture in {**scene_of, **contents.variant_of}.items():
            split = contents.splits[sequence]
            if split_of.setdefault(picture, split) != split:
                raise ValueError(
                    f"picture {picture} would be in the splits {split_of[picture]} and {split}; put all sequences of "
                    "a picture and its variants in one"
                )
        return cls.create_parts(
            path,
            list(contents.splits),
            **vars(contents),
            scene_of=dict(scene_of),
            sensor_height=sensor[0],
            sensor_width=sensor[1],
            conventions=CONVENTIONS,
        )

    def write(
        self,
        sequence: str,
        scene: Polarization,
        trajectory: Mapping[str, Any],
        duration_us: int,
        dynamic_range: float | None = None,
    ) -> None:
        """Write the scene and the trajectory of the next sequence of a part; see `Store.append`.

        The trajectory is plain JSON. With a `dynamic_range`, S0 is logarithmic and spans it. Planes may be numpy or
        torch. TypeError for anything but an array. ValueError for values out of range or not finite, integers, planes
        of different shapes, a scene of an impossible size, or a mask in a store without one.
        """
        if duration_us <= 0:
            raise ValueError(f"{sequence}: expected a duration above 0 us, got {duration_us}")
        record = {
            "trajectory": dict(trajectory),
            "duration_us": int(duration_us),
            "picture_size": list(scene.s0.shape),
        }
        if dynamic_range is not None:
            record["dynamic_range"] = dynamic_range
        self.append(sequence, self._pixels(sequence, scene), record)

    def read(self, sequence: str) -> Polarization:
        """Scene of a sequence; ValueError names the column of damaged data."""
        size = self.record(sequence)["picture_size"]
        (columns,) = self.read_columns(sequence, [*PLANES, *["valid"] * self.masked])
        return Polarization(**{name: dequantise(name, pixels.reshape(size)) for name, pixels in columns.items()})

    def _pixels(self, name: str, scene: Polarization) -> dict[str, np.ndarray]:
        """The columns of a scene; ValueError for a scene that the store cannot hold."""
        planes = {plane: as_tensor(plane, getattr(scene, plane)) for plane in PLANES}
        check_same_shape(planes)
        columns = {plane: quantise(plane, values, "height width") for plane, values in planes.items()}
        height, width = scene.s0.shape
        if height < self.sensor_height or width < self.sensor_width:
            sensor = f"{self.sensor_height}x{self.sensor_width} px"
            raise ValueError(f"{name}: expected a picture of at least the sensor's {sensor}, got {height}x{width}")
        columns |= self.mask_column(scene.valid, scene.s0.shape)
        return {plane: values.ravel() for plane, values in columns.items()}


def as_stored(scene: Polarization) -> Polarization:
    """The scene as a store gives it back, quantised."""
    planes = {plane: dequantise(plane, quantise(plane, getattr(scene, plane))) for plane in PLANES}
    return Polarization(**planes, valid=scene.valid)
