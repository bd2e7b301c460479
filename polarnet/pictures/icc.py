"""Embedded ICC colour profiles: from a device's RGB to sRGB, in floating point.

Pillow's Little CMS works on 8 bits only. Profiles of a matrix and three curves (sRGB, Adobe RGB, Display P3, ProPhoto:
nearly all) are therefore evaluated here; the few profiles of tables go through Pillow.
"""

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

Curve = Callable[[Float[np.ndarray, "..."]], Float[np.ndarray, "..."]]

XYZ_D50_TO_LINEAR_SRGB = np.linalg.inv(
    # columns: the primaries of sRGB adapted to D50 by Bradford's method, as in the profile of IEC 61966-2-1
    [[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]]
)
UNMOVED = 0.5 / 255  # a profile that moves no colour by more than this is sRGB by another name
TABLES = ("A2B0", "A2B1", "D2B0", "D2B1")


@dataclass(frozen=True)
class MatrixProfile:
    """Linear light = curve(code value) per channel; XYZ (D50) = matrix @ linear light."""

    matrix: Float[np.ndarray, "3 3"]
    curves: tuple[Curve, Curve, Curve]


def srgb_from_profile(rgb: Float32[np.ndarray, "h w 3"], profile: bytes) -> Float32[np.ndarray, "h w 3"]:
    """Convert code values in [0, 1] of a device with this ICC profile to sRGB in [0, 1]; clip colours out of gamut.

    Values of an sRGB profile stay unchanged. Profiles made of tables are applied with 8 bits.
    ValueError if the profile is damaged or not for RGB.
    """
    tags = read_tags(profile)
    if any(tag in tags for tag in TABLES):
        return _through_little_cms(rgb, profile)
    device = _matrix_profile(tags)
    return rgb if _is_srgb(device) else _convert(rgb, device)


def read_tags(profile: bytes) -> dict[str, bytes]:
    """Tagged elements of an ICC profile by tag (ICC.1, section 7); ValueError if it is damaged or not for RGB."""
    if len(profile) < 132 or profile[36:40] != b"acsp":
        raise ValueError(f"the embedded colour profile is damaged ({len(profile)} bytes without the mark of ICC)")
    space = profile[16:20].decode("ascii", "replace").strip()
    if space != "RGB":
        raise ValueError(f"the embedded colour profile is one of {space}, not of RGB; convert the file to RGB first")
    (count,) = struct.unpack_from(">I", profile, 128)
    if 132 + 12 * count > len(profile):
        raise ValueError(f"the embedded colour profile is cut off ({len(profile)} bytes, {count} tags)")
    tags = {}
    for i in range(count):
        name, offset, size = struct.unpack_from(">4sII", profile, 132 + 12 * i)
        tags[name.decode("latin-1")] = profile[offset : offset + size]
    return tags


def encode_srgb(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Linear light in [0, 1] to sRGB code values (IEC 61966-2-1); other values are clipped."""
    light = np.clip(linear, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _convert(rgb: Float[np.ndarray, "h w 3"], device: MatrixProfile) -> Float32[np.ndarray, "h w 3"]:
    light = np.stack([curve(rgb[..., c].astype(np.float64)) for c, curve in enumerate(device.curves)], axis=-1)
    return encode_srgb(light @ (XYZ_D50_TO_LINEAR_SRGB @ device.matrix).T).astype(np.float32)


def _is_srgb(device: MatrixProfile) -> bool:
    axis = np.linspace(0, 1, 18, dtype=np.float32)
    lattice = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(18, -1, 3)
    return bool(np.abs(_convert(lattice, device) - lattice).max() < UNMOVED)


def _matrix_profile(tags: dict[str, bytes]) -> MatrixProfile:
    missing = [tag for tag in ("rXYZ", "gXYZ", "bXYZ", "rTRC", "gTRC", "bTRC") if tag not in tags]
    if missing:
        raise ValueError(f"the embedded colour profile has no {', '.join(missing)}")
    try:
        primaries = [struct.unpack_from(">3i", tags[tag], 8) for tag in ("rXYZ", "gXYZ", "bXYZ")]
        red, green, blue = (_curve(tags[tag]) for tag in ("rTRC", "gTRC", "bTRC"))
    except struct.error as error:
        raise ValueError(f"the embedded colour profile is cut off ({error})") from error
    return MatrixProfile(np.array(primaries).T / 65536, (red, green, blue))


def _curve(element: bytes) -> Curve:
    """A tone curve of type `curv` or `para` (ICC.1, sections 10.6 and 10.18)."""
    kind = element[:4]
    if kind == b"para":
        return _parametric_curve(element)
    if kind != b"curv":
        raise ValueError(f"the embedded colour profile has a tone curve of unknown type {kind!r}")
    (count,) = struct.unpack_from(">I", element, 8)
    samples = np.array(struct.unpack_from(f">{count}H", element, 12), dtype=np.float64)
    if count == 0:
        return lambda code: code
    if count == 1:
        return lambda code: code ** (samples[0] / 256)
    return lambda code: np.interp(code, np.linspace(0, 1, count), samples / 65535)


def _parametric_curve(element: bytes) -> Curve:
    """Y = (a X + b)^g + e for X >= d, else c X + f; types 0 to 4 state 1, 3, 4, 5 and 7 of these numbers."""
    (kind,) = struct.unpack_from(">H", element, 8)
    if kind > 4:
        raise ValueError(f"the embedded colour profile has a parametric curve of unknown type {kind}")
    given = [n / 65536 for n in struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", element, 12)]
    g, a, b, c, d, e, f = given + [0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0][len(given) :]
    if a == 0:
        raise ValueError("the embedded colour profile has a parametric curve that is flat")
    if kind in (1, 2):
        c, d, e, f = 0.0, -b / a, c, c
    return lambda code: np.where(code >= d, np.maximum(a * code + b, 0) ** g + e, c * code + f)


def _through_little_cms(rgb: Float32[np.ndarray, "h w 3"], profile: bytes) -> Float32[np.ndarray, "h w 3"]:
    from PIL import Image, ImageCms

    try:
        device = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        transform = ImageCms.buildTransform(device, ImageCms.createProfile("sRGB"), "RGB", "RGB")
    except (ImageCms.PyCMSError, OSError) as error:
        raise ValueError(f"the embedded colour profile cannot be used ({error})") from error
    picture = Image.fromarray(np.round(255 * rgb).astype(np.uint8))
    converted = ImageCms.applyTransform(picture, transform)
    if converted is None:
        raise ValueError("the embedded colour profile cannot be used")
    return np.asarray(converted).astype(np.float32) / 255
