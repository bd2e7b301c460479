"""RGB pictures from any file that OpenImageIO reads: upright, without alpha, in sRGB, cut and scaled to one size."""

import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float, Float32, Shaped, UInt8
from PIL import Image, ImageCms
from torch import Tensor

from polarnet.runtime.files import sha256

MAX_PIXELS = 2**28  # limit for one picture, which takes 3 GiB as float32 RGB
LEAST_WHITE = 2.0**-16  # largest value of a float picture: below it, 16 bits hold nothing but black
SRGB = "srgb_rec709_scene"  # OpenImageIO's name
TAKEN_AS_SRGB = {"", SRGB, "g22_rec709_scene"}  # a PNG that says gamma 1/2.2 is how older programs wrote sRGB
LINEAR_FORMATS = {"openexr", "hdr"}  # hold linear light unless they say otherwise
LIGHT = ".npy"  # suffix of pictures of linear light, float32 [height, width, 3], in data/images
CAMERA_RAW = frozenset([
    "dng", "nef", "nrw", "cr2", "cr3", "crw", "arw", "srf", "sr2", "raf", "orf", "rw2", "pef", "srw", "3fr", "iiq",
    "erf", "mrw", "x3f",
])  # fmt: skip
NOT_IN_THE_WHEEL = frozenset(["heic", "heif", "avif"])
NO_PICTURES = frozenset(["null", "nul", "term", "zfile", "z", "env", "sm", "tx", "vsm", "int", "inta"])
"""Extensions that OpenImageIO lists as well."""
LEVELS = np.linspace(0, 255, 18).astype(np.uint8)
SRGB_LATTICE = np.stack(np.meshgrid(LEVELS, LEVELS, LEVELS), axis=-1).reshape(18, -1, 3)


class UnreadablePicture(ValueError):
    """A file without a usable RGB picture; the message gives the reason."""


@dataclass(frozen=True)
class Picture:
    """A picture in the encoding of its file, turned upright."""

    pixels: Shaped[np.ndarray, "h w 3"]  # uint8, uint16 or float32; white is 1.0 in float32 unless `light`
    profile: bytes | None  # embedded ICC profile
    colour_space: str  # OpenImageIO's name of the encoding; means nothing beside a profile
    light: bool  # whether the pixels are linear light in floating-point numbers, as in OpenEXR and Radiance HDR files
    author: str | None
    licence: str | None

    @property
    def bits(self) -> int:
        """Bits of a PNG that preserves the file's values: 8 for bytes, 16 for finer types."""
        return 8 if self.pixels.dtype == np.uint8 else 16

    @property
    def sha256(self) -> str:
        """Hash of the upright pixels with their shape and type, independent of the file's name and format."""
        pixels = np.ascontiguousarray(self.pixels)
        return sha256(f"{pixels.dtype}{pixels.shape}".encode(), pixels.data)


def extension(path: Path) -> str:
    """Lower-case extension of a file, without the dot."""
    return path.suffix.lower().lstrip(".")


def picture_extensions() -> frozenset[str]:
    """Lower-case extensions, without the dot, of picture files, including formats that cannot be read here."""
    formats = oiio.get_string_attribute("extension_list").split(";")
    known = {name for entry in formats for name in entry.partition(":")[2].split(",")}
    return frozenset(known - NO_PICTURES) | CAMERA_RAW | NOT_IN_THE_WHEEL


def read_picture(path: str | os.PathLike[str], grey: bool = False) -> Picture:
    """Read the first picture of a file, without alpha and turned upright by its EXIF orientation.

    With `grey`, one channel is read as three equal ones, in sRGB unless `light`. UnreadablePicture with the reason,
    such as no picture, damaged, cut off, camera raw, more than MAX_PIXELS, fewer than three channels, a damaged
    profile, or values that are not finite.
    """
    pixels, spec, file_format = _read(Path(path))
    light = _is_light(spec, file_format)
    colours = [i for i in range(spec.nchannels) if i != spec.alpha_channel]
    if grey and len(colours) == 1:
        return Picture(np.repeat(pixels[..., colours], 3, axis=2), None, SRGB, light, None, None)
    profile = spec.get("ICCProfile")
    if profile is None and file_format == "png" and _names_profile(Path(path)):
        raise UnreadablePicture("the embedded colour profile is damaged; save the file again, with or without one")
    return Picture(
        pixels=np.ascontiguousarray(pixels[..., _rgb_channels(spec.channelnames, colours)]),
        profile=None if profile is None else np.asarray(profile, dtype=np.uint8).tobytes(),
        colour_space=_colour_space(spec, file_format),
        light=light,
        author=spec.get_string_attribute("Artist") or None,
        licence=spec.get_string_attribute("Copyright") or None,
    )


def read_channels(path: str | os.PathLike[str]) -> Shaped[np.ndarray, "h w c"]:
    """Code values of all channels except alpha, not turned by an orientation.

    UnreadablePicture as `read_picture`, but any number of channels will do.
    """
    pixels, spec, _ = _read(Path(path), as_stored=True)
    return pixels[..., [i for i in range(spec.nchannels) if i != spec.alpha_channel]]


def upright(pixels: Shaped[np.ndarray, "h w c"], orientation: int) -> Shaped[np.ndarray, "a b c"]:
    """Pixels turned upright by the EXIF orientation, 1 to 8; other numbers count as 1."""
    if orientation in (5, 6, 7, 8):  # stored with rows and columns swapped
        pixels = pixels.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels


def srgb_of(pixels: Float32[np.ndarray, "h w 3"], picture: Picture) -> Float32[np.ndarray, "h w 3"]:
    """Pixels in the colours of `picture` as sRGB code values in [0, 1], out of range clipped.

    The embedded profile decides, in 8 bits; without one, the encoding that the file names. Pixels with neither are sRGB
    already. UnreadablePicture if the profile or encoding cannot be used.
    """
    pixels = np.clip(pixels, 0, 1)
    if picture.profile is not None:
        return _from_profile(pixels, picture.profile)
    if picture.colour_space in TAKEN_AS_SRGB:
        return pixels
    converted = oiio.ImageBufAlgo.colorconvert(oiio.ImageBuf(pixels), picture.colour_space, SRGB)
    if converted.has_error:
        raise UnreadablePicture(f"encoding {picture.colour_space}: {converted.geterror().strip()}")
    return np.clip(np.asarray(converted.get_pixels("float")), 0, 1)


def _from_profile(rgb: Float32[np.ndarray, "h w 3"], profile: bytes) -> Float32[np.ndarray, "h w 3"]:
    """Code values of a device with this ICC profile as sRGB, in 8 bits; unchanged if the profile is sRGB's own."""
    try:
        device = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        transform = ImageCms.buildTransform(device, ImageCms.createProfile("sRGB"), "RGB", "RGB")
    except (ImageCms.PyCMSError, OSError) as error:
        raise UnreadablePicture(
            f"the embedded colour profile cannot be used ({error}); convert the file to sRGB first"
        ) from error

    def converted(levels: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        return np.asarray(ImageCms.applyTransform(Image.fromarray(levels), transform))

    if np.abs(converted(SRGB_LATTICE).astype(int) - SRGB_LATTICE).max() <= 1:  # sRGB, maybe by another name
        return rgb
    return converted(np.round(255 * rgb).astype(np.uint8)).astype(np.float32) / 255


def code_fractions(pixels: Shaped[np.ndarray, "h w *c"]) -> Float32[np.ndarray, "h w *c"]:
    """Code values as fractions of white: integers become [0, 1]."""
    white = np.iinfo(pixels.dtype).max if np.issubdtype(pixels.dtype, np.integer) else 1
    return pixels.astype(np.float32) / np.float32(white)


def fit(
    pixels: Shaped[np.ndarray, "h w *c"], height: int, width: int, max_upscale: float
) -> Float32[np.ndarray, "height width *c"]:
    """Cut out the largest centred part of shape height:width and scale it to that size; integers become [0, 1].

    Shrinks by averaging areas, enlarges by cubic interpolation, without decoding the pixels to linear light.
    UnreadablePicture if the part would be enlarged more than `max_upscale` times.
    """
    rows, columns = pixels.shape[:2]
    part_height = min(rows, max(1, round(columns * height / width)))
    part_width = min(columns, max(1, round(rows * width / height)))
    enlargement = max(height / part_height, width / part_width)
    if enlargement > max_upscale:
        raise UnreadablePicture(
            f"too small: {columns}x{rows} pixels would be enlarged {enlargement:.2f} times to fill {width}x{height}, "
            f"more than ingest.max_upscale={max_upscale:g}"
        )
    top, left = (rows - part_height) // 2, (columns - part_width) // 2
    values = code_fractions(pixels[top : top + part_height, left : left + part_width])
    if (part_height, part_width) == (height, width):
        return values
    method = cv2.INTER_CUBIC if enlargement > 1 else cv2.INTER_AREA
    scaled = cv2.resize(values, (width, height), interpolation=method).astype(np.float32)
    return np.clip(scaled, 0, 1) if enlargement > 1 else scaled  # cubic interpolation overshoots at edges


def write_png(path: str | os.PathLike[str], rgb: Float32[np.ndarray, "h w 3"], bits: int) -> None:
    """sRGB code values in [0, 1] as PNG with 8 or 16 bits; the same values give the same bytes."""
    levels = 2**bits - 1
    quantised = np.round(rgb.astype(np.float64) * levels).astype(np.uint8 if bits == 8 else np.uint16)
    done, encoded = cv2.imencode(".png", quantised[..., ::-1])
    if not done:
        raise OSError(f"{path}: OpenCV could not encode {rgb.shape} as PNG")
    Path(path).write_bytes(encoded.tobytes())


def read_rgb(path: str | os.PathLike[str]) -> Float[Tensor, "3 h w"]:
    """sRGB code values in [0, 1] of a whole picture; raises like `read_picture` and `srgb_of`.

    >>> from polarnet.pictures import BUILTIN_PHOTOS, read_rgb
    >>> read_rgb(BUILTIN_PHOTOS[0].path).shape
    torch.Size([3, 512, 512])
    """
    picture = read_picture(path)
    _check_white(picture.pixels)
    rgb = srgb_of(code_fractions(picture.pixels), picture)
    return torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1)))


def read_light(path: str | os.PathLike[str]) -> Float32[Tensor, "3 h w"]:
    """Light of a picture in linear floating-point numbers (OpenEXR, Radiance HDR), as shares of the brightest value.

    UnreadablePicture as `read_picture`, for a file that does not hold light, and for a picture without light.

    >>> import numpy as np
    >>> import OpenImageIO as oiio
    >>> from polarnet.pictures import read_light
    >>> oiio.ImageBuf(np.array([[[20.0, 2.0, 2e-5]]], np.float32)).write("lamp.exr")
    True
    >>> read_light("lamp.exr").ravel()
    tensor([1.0000e+00, 1.0000e-01, 1.0000e-06])
    """
    picture = read_picture(path)
    if not picture.light:
        raise UnreadablePicture(
            f"expected linear light in floating-point numbers, as in .exr and .hdr files, got {picture.pixels.dtype} "
            f"in {picture.colour_space or 'no known encoding'}; read_rgb reads other pictures"
        )
    return torch.from_numpy(np.ascontiguousarray(light_of(picture.pixels).transpose(2, 0, 1)))


def holds_light(path: str | os.PathLike[str]) -> bool:
    """Whether a file holds linear light in floating-point numbers, as OpenEXR and Radiance HDR files do.

    Only its header is read; False for a file that cannot be opened.
    """
    try:
        file = _opened(Path(path))
    except UnreadablePicture:
        return False
    spec, file_format = file.spec(), file.format_name()
    file.close()
    return _is_light(spec, file_format)


def light_of(pixels: Float32[np.ndarray, "h w 3"], white: float | None = None) -> Float32[np.ndarray, "h w 3"]:
    """Pixels of linear light as shares of `white`, clipped to [0, 1]; None: of their brightest value.

    Without `white` nothing is clipped but negative values, so that the picture keeps its range. UnreadablePicture for a
    picture without light.
    """
    white = float(pixels.max()) if white is None else white
    if not white > 0:
        raise UnreadablePicture("no light: no value is above 0")
    return np.clip(pixels / np.float32(white), 0, 1)


def _read(path: Path, as_stored: bool = False) -> tuple[Shaped[np.ndarray, "h w c"], Any, str]:
    """Pixels of all channels, upright unless `as_stored`; OpenImageIO's description; the name of the format."""
    kind = extension(path)
    if kind in CAMERA_RAW:
        raise UnreadablePicture("camera raw: only a preview in it can be read; develop it to 16-bit TIFF first")
    if kind in NOT_IN_THE_WHEEL:
        raise UnreadablePicture(f"OpenImageIO's wheel has no reader for .{kind}; convert it to PNG or TIFF first")
    file = _opened(path)
    try:
        spec = file.spec()
        if spec.width * spec.height > MAX_PIXELS:
            raise UnreadablePicture(f"expected at most {MAX_PIXELS:,} pixels, got {spec.width}x{spec.height}")
        pixels = file.read_image(0, 0, 0, spec.nchannels, "unknown")
        problem = file.geterror()
    finally:
        file.close()
    if pixels is None or problem:
        raise UnreadablePicture(f"cannot be read: {_first_line(problem, path)}")
    pixels, file_format = _plain(pixels), file.format_name()
    if not _is_light(spec, file_format):
        _check_white(pixels)
    orientation = 1 if as_stored else spec.get_int_attribute("Orientation", 1)
    return upright(pixels, orientation), spec, file_format


def _opened(path: Path) -> Any:
    """OpenImageIO's reader of a file; UnreadablePicture if it cannot be opened."""
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError:
        raise UnreadablePicture("cannot be read: the name of the file is not UTF-8; rename it") from None
    unmultiplied = oiio.ImageSpec()
    unmultiplied["oiio:UnassociatedAlpha"] = 1  # otherwise the reader multiplies the colours by alpha
    file = oiio.ImageInput.open(str(path), unmultiplied)
    if file is None:
        raise UnreadablePicture(f"cannot be read: {_first_line(oiio.geterror(), path)}")
    return file


def _is_light(spec: Any, file_format: str) -> bool:
    floating = spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
    return floating and "lin" in _colour_space(spec, file_format)


def _colour_space(spec: Any, file_format: str) -> str:
    """OpenImageIO's name of a file's encoding; empty if it is not known."""
    named = spec.get_string_attribute("oiio:ColorSpace")
    return named or ("lin_rec709_scene" if file_format in LINEAR_FORMATS else "")


def _names_profile(png: Path) -> bool:
    """Whether a PNG has a colour profile before its pixels; OpenImageIO ignores a damaged one."""
    with png.open("rb") as file:
        return b"iCCP" in file.read(2**20).partition(b"IDAT")[0]


def _rgb_channels(names: Sequence[str], colours: list[int]) -> list[int]:
    """Indices of R, G and B; without these names, the first three of `colours`, the channels except alpha."""
    capitals = [name.upper() for name in names]
    if all(name in capitals for name in "RGB"):
        return [capitals.index(name) for name in "RGB"]
    if len(colours) < 3:
        words = "one channel" if len(colours) == 1 else f"{len(colours)} channels"
        raise UnreadablePicture(f"{words}, no RGB: saturation and hue, and so polarization, would be 0 everywhere")
    return colours[:3]


def _plain(pixels: Shaped[np.ndarray, "h w c"]) -> Shaped[np.ndarray, "h w c"]:
    """Pixels as uint8, uint16 or float32; UnreadablePicture if a value is not finite."""
    if pixels.dtype in (np.uint8, np.uint16):
        return pixels
    if np.issubdtype(pixels.dtype, np.integer):
        return (pixels / np.iinfo(pixels.dtype).max).astype(np.float32)
    if not np.isfinite(pixels).all():
        raise UnreadablePicture(f"{np.count_nonzero(~np.isfinite(pixels))} values are not finite numbers")
    return pixels.astype(np.float32)


def _check_white(pixels: Shaped[np.ndarray, "h w c"]) -> None:
    """UnreadablePicture for floating-point values that cannot have 1.0 as white."""
    if np.issubdtype(pixels.dtype, np.integer):
        return
    middle, largest = float(np.median(pixels.astype(np.float64))), float(pixels.max())
    if not 0 <= middle <= 1 or 0 < largest < LEAST_WHITE:
        raise UnreadablePicture(
            f"expected floats with 1.0 as white, got a median of {middle:g} and at most {largest:g}; scale the picture"
        )


def _first_line(message: str, path: Path) -> str:
    """OpenImageIO's message without the folder, which differs between machines."""
    lines = message.replace(str(path), path.name).strip().splitlines()
    return lines[0] if lines else "OpenImageIO gives no reason"
