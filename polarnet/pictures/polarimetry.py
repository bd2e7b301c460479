"""Measured polarization: linear pictures behind polarizers at 0, 45, 90 and 135 degrees, or a mosaic of them."""

import os
import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Shaped
from torch import Tensor

from polarnet.pictures.images import UnreadablePicture, extension, fit, read_channels
from polarnet.stokes import POLARIZER_ANGLES_DEG, Mosaic, parse_mosaic

ANGLE_SUFFIX = re.compile(r"(?P<name>.+)_0{0,2}(?P<angle>0|45|90|135)")
NUMBERED = re.compile(r"(?P<name>.+)_\d+")
WIDTHS = (10, 12, 14, 16)  # bits of a value of a camera in a 16-bit file
STEPS = 2**16 - 1  # code value of an intensity of 1 in the files written here
COLOURS = ("RGGB", "BGGR", "GRBG", "GBRG")  # order of the four 2x2 blocks in a colour sensor's 4x4 (Sony IMX250MYR)
MIN_MOSAIC_SIDE = 6  # pixels; demosaicking leaves out the cells on the rim
NPZ_KEYS = tuple(f"I{angle}" for angle in POLARIZER_ANGLES_DEG)


@dataclass(frozen=True)
class Measurement:
    """Four pictures of one still scene."""

    intensities: Float32[np.ndarray, "4 h w"]  # linear in light; S0 = I0 + I90 is 1 where unpolarized light saturates
    valid: Bool[np.ndarray, "h w"]  # False where saturation hides what the light was
    residual: float  # median of |I0 + I90 - I45 - I135| / S0 over unsaturated, lit pixels; 0 for ideal polarizers
    saturated: float  # share of pixels with at least one saturated angle


def group_by_measurement(files: Sequence[Path]) -> list[tuple[Path, ...]]:
    """Group the files NAME_0, NAME_45, NAME_90, NAME_135 of a folder; every other file is a group of its own.

    NAME_1 or another number beside them shows that the numbers count frames: then each file is a group of its own.
    """
    groups: dict[Path, list[Path]] = {}
    for file in files:
        match = NUMBERED.fullmatch(file.stem) if extension(file) != "npz" else None
        groups.setdefault(file.with_name(match["name"]) if match else file, []).append(file)
    return [
        part
        for group in groups.values()
        for part in ([tuple(sorted(group))] if all(map(_names_angle, group)) else [(file,) for file in group])
    ]


def are_measurements(groups: Sequence[tuple[Path, ...]]) -> bool:
    """Whether all groups of a folder's files are measurements with a file per angle, complete or not, or .npz files.

    Files that only name an angle, such as A_0 and B_0, are none.
    """
    certain = [len(group) > 1 or extension(group[0]) == "npz" for group in groups]
    return any(certain) and all(sure or _names_angle(group[0]) for sure, group in zip(certain, groups, strict=True))


def _names_angle(file: Path) -> bool:
    return ANGLE_SUFFIX.fullmatch(file.stem) is not None


def _counts_frames(file: Path) -> bool:
    """Whether a number that is no angle lies beside NAME_0."""
    numbered = [beside for beside in file.parent.iterdir() if NUMBERED.fullmatch(beside.stem)]
    name = file.stem.rpartition("_")[0]
    return any(beside.stem.rpartition("_")[0] == name and not _names_angle(beside) for beside in numbered)


def parse_raw_mosaic(order: str) -> tuple[Mosaic, str | None]:
    """Angles of a raw mosaic, and a colour sensor's colours of the 2x2 blocks in each 4x4: "RGGB 90 45 / 135 0"."""
    colours, _, angles = order.strip().partition(" ")
    return (parse_mosaic(angles), colours) if colours in COLOURS else (parse_mosaic(order), None)


def read_measurement(
    files: Sequence[Path], mosaic: Mosaic, colours: str | None = None, white: float | None = None
) -> Measurement:
    """Read a measurement from four pictures, one .npz with I0, I45, I90, I135, or one raw mosaic (`parse_raw_mosaic`).

    Pixels stay as they are stored: an EXIF orientation would turn the scene, but not the angles of the polarizers.
    `white` is the level of saturation; None: `white_level`. One saturated angle of a pixel is computed from the others,
    I0 + I90 = I45 + I135; pixels with more are not valid.
    UnreadablePicture if files are missing, damaged, brighter than `white`, or do not belong together.
    """
    levels = read_levels(files)
    values, saturated = levels_at_angles(levels, white_level(levels, white), mosaic, colours)
    i0, i45, i90, i135 = values
    total, count = values.sum(axis=0) / 2, saturated.sum(axis=0)
    trusted = (count == 0) & (total > 0)
    if not trusted.any():
        raise UnreadablePicture("no pixel is lit and unsaturated at all four angles")
    residual = float(np.median(np.abs(i0 + i90 - i45 - i135)[trusted] / total[trusted]))
    return Measurement(values.astype(np.float32), count <= 1, residual, saturated=float((count > 0).mean()))


def read_levels(paths: Sequence[Path]) -> Shaped[np.ndarray, "n h w"]:
    """Code values in a group of files: four angles (n = 4), or a raw mosaic (n = 1); raises as `read_measurement`."""
    if extension(paths[0]) == "npz":
        return _read_npz(paths[0])
    raw = len(paths) == 1 and (not _names_angle(paths[0]) or _counts_frames(paths[0]))
    return read_raw(paths) if raw else _read_angles(paths)


def levels_at_angles(
    levels: Shaped[np.ndarray, "n h w"], white: float, mosaic: Mosaic | None, colours: str | None = None
) -> tuple[Float64[np.ndarray, "4 h2 w2"], Bool[np.ndarray, "4 h2 w2"]]:
    """Intensities at 0, 45, 90 and 135 degrees, and which of them saturate; S0 = I0 + I90 = 1 at I0 = I90 = `white`.

    `levels` are those of four angles, or of one raw frame of a `mosaic`, which is demosaicked. If one angle of a pixel
    saturates, its intensity is computed from the other three.
    """
    values = levels.astype(np.float64)
    saturated = values >= white
    if len(values) != len(POLARIZER_ANGLES_DEG):
        assert mosaic is not None
        saturated = demosaic(saturated[0].astype(np.float64), mosaic, colours) > 0
        values = demosaic(values[0], mosaic, colours)
    i0, i45, i90, i135 = values = values / (2 * white)
    from_the_others = np.stack([i45 + i135 - i90, i0 + i90 - i135, i45 + i135 - i0, i0 + i90 - i45])
    alone = saturated & (saturated.sum(axis=0) == 1)
    return np.where(alone, np.maximum(from_the_others, values), values), saturated


def demosaic(
    raw: Float64[np.ndarray, "h w"], mosaic: Mosaic, colours: str | None = None
) -> Float64[np.ndarray, "4 h2 w2"]:
    """Each angle at the centre of every 2x2 cell but those on the rim: shape (h // 2 - 2, w // 2 - 2).

    The four pixels of a cell look at four places, and an edge between them would look polarized. So each angle is
    interpolated bilinearly, with weights 9, 3, 3, 1 of 16. A sensor with `colours` has cells of 4x4 pixels, of which
    the mean of the two green blocks counts; it lies half a pixel from the cell's centre.
    """
    cell, near = (2, 3) if colours is None else (4, 7)
    height, width = raw.shape[0] // cell, raw.shape[1] // cell
    greens = [(0, 0)] if colours is None else [divmod(k, 2) for k, colour in enumerate(colours) if colour == "G"]
    at_angle = {}
    for row in (0, 1):
        for column in (0, 1):
            whole = raw[row : cell * height, column : cell * width]
            blocks = [whole[2 * down :: cell, 2 * right :: cell] for down, right in greens]
            samples = blocks[0] if colours is None else (blocks[0] + blocks[1]) / 2
            # the centre of a cell lies below its upper samples and above its lower ones
            vertical = samples[2:] if row == 0 else samples[:-2]
            samples = (near * samples[1:-1] + vertical) / (near + 1)
            horizontal = samples[:, 2:] if column == 0 else samples[:, :-2]
            at_angle[mosaic[row][column]] = (near * samples[:, 1:-1] + horizontal) / (near + 1)
    return np.stack([at_angle[angle] for angle in POLARIZER_ANGLES_DEG])


def shrink(measurement: Measurement, height: int, width: int) -> Measurement:
    """Cut out the centre of shape height:width and average it to that size; unchanged if it would be enlarged.

    A pixel is valid if all pixels that it averages are valid.
    """
    planes = *measurement.intensities, ~measurement.valid
    try:
        *intensities, invalid = (fit(plane, height, width, max_upscale=1.0) for plane in planes)
    except UnreadablePicture:
        return measurement
    return replace(measurement, intensities=np.stack(intensities), valid=invalid == 0)


def write_intensities(path: str | os.PathLike[str], measurement: Measurement) -> None:
    """Write .npz with I0, I45, I90, I135 (uint16, 65535 is S0 = 1) and valid; equal measurements give equal bytes."""
    steps = np.round(np.clip(measurement.intensities, 0, 1) * STEPS).astype(np.uint16)
    np.savez_compressed(path, **dict(zip(NPZ_KEYS, steps, strict=True)), valid=measurement.valid)


def read_intensities(path: str | os.PathLike[str]) -> tuple[Float32[Tensor, "4 h w"], Bool[Tensor, "h w"]]:
    """Intensities behind the four polarizers and their valid pixels, from a file of `write_intensities`."""
    with np.load(path) as file:
        steps = np.stack([file[key] for key in NPZ_KEYS])
        return torch.from_numpy(steps.astype(np.float32) / STEPS), torch.from_numpy(file["valid"])


def white_level(values: Shaped[np.ndarray, "n h w"], stated: float | None = None) -> float:
    """Level at which values saturate: `stated`, or found in values of 8 or 16 bits or floats in [0, 1].

    In 16-bit files it is the lowest top of 10, 12, 14 or 16 bits that holds all values. Low bits that are 0 in all
    values do not count, so that 12 bits at the upper end of 16 saturate at 65520. UnreadablePicture for values above
    `stated` or of other types.
    """
    if stated is not None:
        if values.max() > stated:
            raise UnreadablePicture(
                f"expected levels up to {stated:g}, got {values.max():g}; state the level at which the camera "
                f"saturates, with ingest.white or --white"
            )
        return stated
    if values.dtype == np.uint8:
        return 255.0
    if values.dtype == np.uint16:
        used = int(np.bitwise_or.reduce(values, axis=None))
        spare = max(0, (used & -used).bit_length() - 1)  # bits below the lowest in use
        pairs = [(width, width - bits) for width in WIDTHS for bits in WIDTHS] + [(16, 8)]
        tops = [2**width - 2**low for width, low in pairs if 0 <= low <= spare]
        return float(min(top for top in tops if top >= values.max()))
    if np.issubdtype(values.dtype, np.floating):
        if not (values.min() >= 0 and values.max() <= 1):  # false for NaN too
            raise UnreadablePicture(f"expected floats in [0, 1], got {values.min():g} to {values.max():g}")
        return 1.0
    raise UnreadablePicture(f"expected 8 or 16 bits or floats in [0, 1], got {values.dtype}")


def _read_npz(path: Path) -> Shaped[np.ndarray, "4 h w"]:
    try:
        with np.load(path) as file:
            arrays = {key: file[key] for key in NPZ_KEYS if key in file}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UnreadablePicture(f"cannot be read: {error}".replace(str(path), path.name)) from error
    if missing := [key for key in NPZ_KEYS if key not in arrays]:
        raise UnreadablePicture(f"expected the arrays {', '.join(NPZ_KEYS)}, {', '.join(missing)} is missing")
    return _stacked([*arrays.values()], NPZ_KEYS)


def _read_angles(files: Sequence[Path]) -> Shaped[np.ndarray, "4 h w"]:
    """Read a file per angle; colour pictures give their green channel, because polarization differs between colours."""
    by_angle: dict[int, Path] = {}
    for file in files:
        match = ANGLE_SUFFIX.fullmatch(file.stem)
        if match is None or by_angle.setdefault(int(match["angle"]), file) != file:
            raise UnreadablePicture(f"two files for one angle: {', '.join(file.name for file in files)}")
    missing = [angle for angle in POLARIZER_ANGLES_DEG if angle not in by_angle]
    if missing:
        raise UnreadablePicture(f"no file for {', '.join(f'_{angle}' for angle in missing)} beside {files[0].name}")
    pictures = [read_channels(by_angle[angle]) for angle in POLARIZER_ANGLES_DEG]
    planes = [picture[..., 1 if picture.shape[2] >= 3 else 0] for picture in pictures]
    return _stacked(planes, [by_angle[angle].name for angle in POLARIZER_ANGLES_DEG])


def read_raw(paths: Sequence[Path]) -> Shaped[np.ndarray, "1 h w"]:
    """Code values of the one file of a raw mosaic; raises as `read_measurement`."""
    (path,) = paths
    pixels = read_channels(path)
    if pixels.shape[2] != 1:
        raise UnreadablePicture(
            f"{pixels.shape[2]} channels: neither a raw mosaic nor one of NAME_0, NAME_45, NAME_90, NAME_135"
        )
    if min(pixels.shape[:2]) < MIN_MOSAIC_SIDE:
        raise UnreadablePicture(f"too small for a mosaic: {pixels.shape[1]}x{pixels.shape[0]} pixels")
    return pixels[..., 0][None]


def _stacked(planes: Sequence[np.ndarray], names: Sequence[str]) -> Shaped[np.ndarray, "4 h w"]:
    kinds = {(plane.shape, plane.dtype) for plane in planes}
    if len(kinds) > 1 or planes[0].ndim != 2:
        sizes = ", ".join(f"{name} {plane.dtype} {plane.shape}" for name, plane in zip(names, planes, strict=True))
        raise UnreadablePicture(f"expected four pictures of one size and type, got {sizes}")
    return np.stack(planes)
