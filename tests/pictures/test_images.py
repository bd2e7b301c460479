"""Reading pictures: every kind of file is made here, by another program than the one that reads it."""

import io
import os
import struct
import zlib
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from PIL import Image, ImageCms

from polarnet.pictures.images import (
    Picture,
    UnreadablePicture,
    fit,
    picture_extensions,
    read_picture,
    read_rgb,
    srgb_of,
    upright,
    write_png,
)


@pytest.fixture
def rgb8() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB code values of linear light in [0, 1] (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def srgb_from_profile(rgb: np.ndarray, profile: bytes) -> np.ndarray:
    return srgb_of(rgb, Picture(rgb, profile, "", None, None, None))


def reason(path: Path) -> str:
    with pytest.raises(UnreadablePicture) as caught:
        read_picture(path)
    return str(caught.value)


def test_a_16_bit_tiff_keeps_its_16_bits(tmp_path):
    values = np.arange(65536, dtype=np.uint16)[::32][:1800].reshape(20, 30, 3)
    tifffile.imwrite(tmp_path / "deep.tif", values)
    picture = read_picture(tmp_path / "deep.tif")
    assert picture.bits == 16
    write_png(tmp_path / "deep.png", fit(picture.pixels, 20, 30, 1.0), picture.bits)
    assert np.array_equal(read_picture(tmp_path / "deep.png").pixels, values)


def test_alpha_is_dropped_and_does_not_darken_the_colours(tmp_path, rgb8):
    half_transparent = np.dstack([rgb8, np.full((20, 30), 128, np.uint8)])
    Image.fromarray(half_transparent).save(tmp_path / "a.png")
    tifffile.imwrite(tmp_path / "a.tif", half_transparent, photometric="rgb", extrasamples=["unassalpha"])
    for name in ("a.png", "a.tif"):
        assert np.array_equal(read_picture(tmp_path / name).pixels, rgb8)


def test_every_exif_orientation_shows_the_same_upright_picture(tmp_path):
    blocks = np.zeros((16, 24, 3), dtype=np.uint8)
    blocks[:8, :8], blocks[8:, 16:], blocks[:8, 16:] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    stored = {
        1: blocks,
        2: blocks[:, ::-1],
        3: blocks[::-1, ::-1],
        4: blocks[::-1],
        5: blocks.transpose(1, 0, 2),
        6: np.rot90(blocks, 1),  # turned left, so that a viewer turns it right
        7: np.rot90(blocks, 2).transpose(1, 0, 2),
        8: np.rot90(blocks, -1),
    }
    for orientation, pixels in stored.items():
        exif = Image.Exif()
        exif[0x0112] = orientation
        path = tmp_path / f"{orientation}.jpg"
        Image.fromarray(np.ascontiguousarray(pixels)).save(path, exif=exif, quality=100, subsampling=0)
        turned = read_picture(path).pixels
        assert turned.shape == blocks.shape, orientation
        assert np.abs(turned.astype(int) - blocks).max() < 8, orientation
        assert np.array_equal(upright(pixels, orientation), blocks), orientation


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".jp2", ".bmp"])
def test_a_file_that_ends_early_is_refused(tmp_path, suffix):
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / f"whole{suffix}")
    content = (tmp_path / f"whole{suffix}").read_bytes()
    (tmp_path / f"cut{suffix}").write_bytes(content[: len(content) // 2])
    read_picture(tmp_path / f"whole{suffix}")
    assert "cannot be read" in reason(tmp_path / f"cut{suffix}")


def test_files_without_a_usable_picture_are_refused_with_the_reason(tmp_path, rgb8):
    (tmp_path / "text.png").write_text("not a picture")
    (tmp_path / "empty.jpg").touch()
    tifffile.imwrite(tmp_path / "grey.tif", np.zeros((20, 30), np.uint16))
    Image.fromarray(np.zeros((20, 30, 2), np.uint8), "LA").save(tmp_path / "grey_alpha.png")
    tifffile.imwrite(tmp_path / "a.tif", rgb8)
    (tmp_path / "a.tif").rename(tmp_path / "a.dng")  # a DNG is a TIFF whose first picture is a preview
    values = np.zeros((20, 30, 3), np.float32)
    values[0, 0, 0] = np.nan
    tifffile.imwrite(tmp_path / "nan.tif", values, photometric="rgb")
    content = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    chunk = struct.pack(">I4s", 12, b"iCCP") + b"x\0\0not a zlib"[:12]
    profile = chunk + struct.pack(">I", zlib.crc32(chunk[4:]))
    (tmp_path / "profile.png").write_bytes(content[:33] + profile + content[33:])
    for name, words in (
        ("text.png", "cannot be read: Not a PNG file"), ("empty.jpg", 'cannot be read: Empty file "empty.jpg"'),
        ("grey.tif", "one channel"), ("grey_alpha.png", "one channel"), ("a.dng", "camera raw"),
        ("nan.tif", "1 values are not finite numbers"), ("profile.png", "the embedded colour profile is damaged"),
        ("missing.jpg", 'cannot be read: Could not open file "missing.jpg"'),
    ):  # fmt: skip
        assert reason(tmp_path / name).startswith(words)


def test_linear_light_in_an_exr_is_encoded_as_srgb(tmp_path):
    linear = np.linspace(0, 1, 1800, dtype=np.float32).reshape(20, 30, 3)
    file = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    file.open(str(tmp_path / "a.exr"), oiio.ImageSpec(30, 20, 3, "float"))
    file.write_image(linear)
    file.close()
    rgb = read_rgb(tmp_path / "a.exr").permute(1, 2, 0).numpy()
    np.testing.assert_allclose(rgb, encode_srgb(linear), atol=1e-4)


def test_the_same_pixels_have_the_same_hash_in_every_format(tmp_path, rgb8):
    Image.fromarray(rgb8).save(tmp_path / "a.png")
    assert np.array_equal(read_picture(str(tmp_path / "a.png")).pixels, rgb8)
    Image.fromarray(rgb8).save(tmp_path / "b.bmp")
    tifffile.imwrite(tmp_path / "c.tif", rgb8)
    assert len({read_picture(tmp_path / name).sha256 for name in ("a.png", "b.bmp", "c.tif")}) == 1


def test_the_centre_of_shape_3_to_2_is_kept():
    tall = np.zeros((90, 30, 3), np.uint8)
    tall[35:55] = 255  # the middle 20 rows of 90
    assert fit(tall, 20, 30, 1.0).min() == 1
    wide = np.zeros((20, 100, 3), np.uint8)
    wide[:, 35:65] = 255
    assert fit(wide, 20, 30, 1.0).min() == 1


def test_shrinking_averages_areas():
    checks = np.zeros((40, 60, 3), np.uint8)
    checks[::2, ::2] = checks[1::2, 1::2] = 255
    assert np.all(fit(checks, 20, 30, 1.0) == 0.5)


def test_enlarging_stays_within_0_and_1_and_is_refused_beyond_the_limit():
    edge = np.zeros((10, 15, 3), np.uint8)
    edge[:, 7:] = 255
    enlarged = fit(edge, 20, 30, 2.0)
    assert enlarged.shape == (20, 30, 3)
    assert enlarged.min() == 0
    assert enlarged.max() == 1
    with pytest.raises(UnreadablePicture, match=r"too small: 15x10 pixels would be enlarged 2.00 times"):
        fit(edge, 20, 30, 1.9)


def test_extensions_name_pictures_and_not_openimageio_s_other_formats():
    extensions = picture_extensions()
    assert {"jpg", "jpeg", "tif", "tiff", "png", "exr", "webp", "jxl", "dng", "heic"} <= extensions
    assert not {"null", "term", "z", "env", "txt", "csv"} & extensions


# -- colour profiles ---------------------------------------------------------------------------------------------------

BRADFORD_PRIMARIES = {  # columns of the D50 matrices: published in the profiles of these spaces
    "display_p3": [(0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407)],
    "prophoto": [(0.79767, 0.28804, 0.0), (0.13519, 0.71188, 0.0), (0.03134, 0.00009, 0.82491)],
    "adobe": [(0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457)],
    "srgb": [(0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.71410)],
}
GAMMA_TABLE = struct.pack(">4s4xI", b"curv", 256) + struct.pack(
    ">256H", *(round(65535 * (i / 255) ** 1.8) for i in range(256))
)
CURVES = {
    "gamma": struct.pack(">4s4xIH2x", b"curv", 1, round(2.2 * 256)),
    "identity": struct.pack(">4s4xI", b"curv", 0),
    "table": GAMMA_TABLE,
    "para0": struct.pack(">4s4xH2xi", b"para", 0, round(1.8 * 65536)),
    "para3": struct.pack(
        ">4s4xH2x5i", b"para", 3, *(round(65536 * x) for x in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045))
    ),
}


def fixed(*numbers: float) -> bytes:
    return struct.pack(f">{len(numbers)}i", *(round(65536 * x) for x in numbers))


def icc(space: bytes, connection: bytes, version: int, elements: dict[bytes, bytes]) -> bytes:
    """A profile laid out as ICC.1 section 7 says."""
    white = fixed(0.9642, 1.0, 0.8249)
    elements = {
        b"desc": struct.pack(">4s4xI5s79x", b"desc", 5, b"test\0"),
        b"cprt": struct.pack(">4s4x5s3x", b"text", b"none\0"),
        b"wtpt": b"XYZ \0\0\0\0" + white,
        **elements,
    }
    table, data, offset = b"", b"", 132 + 12 * len(elements)
    for tag, element in elements.items():
        table += struct.pack(">4sII", tag, offset + len(data), len(element))
        data += element + bytes(-len(element) % 4)
    header = struct.pack(">I4xI4s4s4s12x4s28x", offset + len(data), version, b"mntr", space, connection, b"acsp")
    return header + white + bytes(48) + struct.pack(">I", len(elements)) + table + data


def matrix_profile(primaries: str, curve: str, space: bytes = b"RGB ") -> bytes:
    columns = zip((b"rXYZ", b"gXYZ", b"bXYZ"), BRADFORD_PRIMARIES[primaries], strict=True)
    elements = {tag: b"XYZ \0\0\0\0" + fixed(*column) for tag, column in columns}
    curves = dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), CURVES[curve])
    return icc(space, b"XYZ ", 0x04000000 if curve.startswith("para") else 0x02100000, elements | curves)


def table_profile_that_swaps_red_and_blue() -> bytes:
    """A 2x2x2 table (type mft2): each corner of the cube has the CIELAB value of sRGB with red and blue swapped."""
    lab = {
        (0, 0, 0): (0.0, 0.0, 0.0),
        (1, 0, 0): (54.29, 80.80, 69.89),
        (0, 1, 0): (87.82, -79.27, 80.99),
        (0, 0, 1): (29.57, 68.30, -112.03),
        (1, 1, 0): (97.61, -15.75, 93.39),
        (0, 1, 1): (90.67, -50.66, -14.96),
        (1, 0, 1): (60.17, 93.54, -60.50),
        (1, 1, 1): (100.0, 0.0, 0.0),
    }
    corners = [lab[b, g, r] for r in (0, 1) for g in (0, 1) for b in (0, 1)]
    grid = b"".join(struct.pack(">3H", round(x * 652.8), *(round(256 * (c + 128)) for c in ab)) for x, *ab in corners)
    linear = struct.pack(">2H", 0, 65535) * 3
    header = b"mft2\0\0\0\0" + bytes([3, 3, 2, 0]) + fixed(1, 0, 0, 0, 1, 0, 0, 0, 1) + struct.pack(">2H", 2, 2)
    return icc(b"RGB ", b"Lab ", 0x02100000, {b"A2B0": header + linear + grid + linear})


@pytest.mark.parametrize(("primaries", "curve"), [("display_p3", "para3"), ("prophoto", "para0"), ("adobe", "table")])
def test_grey_of_any_profile_stays_grey_and_follows_its_curve(primaries, curve):
    grey = np.repeat(np.linspace(0, 1, 52, dtype=np.float32)[None, :, None], 3, axis=2)
    gamma = {"para0": 1.8, "table": 1.8}.get(curve)
    expected = grey if gamma is None else encode_srgb(grey**gamma)
    np.testing.assert_allclose(srgb_from_profile(grey, matrix_profile(primaries, curve)), expected, atol=2.5 / 255)


def test_a_photograph_in_adobe_rgb_comes_out_as_little_cms_converts_it():
    path = Path(str(resources.files("skimage"))) / "data" / "rocket.jpg"
    stored = Image.open(path)
    device = ImageCms.ImageCmsProfile(io.BytesIO(stored.info["icc_profile"]))
    expected = np.asarray(ImageCms.profileToProfile(stored, device, ImageCms.createProfile("sRGB"))).astype(int)
    got = np.round(255 * read_rgb(path).permute(1, 2, 0).numpy()).astype(int)
    assert np.abs(got - expected).max() <= 1
    assert np.abs(got - np.asarray(stored).astype(int)).max() > 10


@pytest.mark.parametrize("curve", ["para3", "gamma"])
def test_an_srgb_profile_keeps_all_16_bits(tmp_path, curve):
    ramp = np.repeat(np.arange(600, dtype=np.uint16).reshape(20, 30, 1) * 20 + 20000, 3, axis=2)
    tifffile.imwrite(tmp_path / "deep.tif", ramp, iccprofile=matrix_profile("srgb", curve))
    values = len(np.unique(read_rgb(tmp_path / "deep.tif")[1]))
    assert values == 600 if curve == "para3" else values < 80  # another curve converts to 8 bits


def test_a_profile_made_of_tables_is_followed():
    colours = np.array([[(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (0, 0, 0)]], dtype=np.float32)
    swapped = srgb_from_profile(colours, table_profile_that_swaps_red_and_blue())
    np.testing.assert_allclose(swapped, colours[..., ::-1], atol=3 / 255)


@pytest.mark.parametrize(
    "profile",
    [
        b"short",
        matrix_profile("adobe", "gamma", b"CMYK"),
        matrix_profile("adobe", "gamma").replace(b"gTRC", b"none"),
        matrix_profile("adobe", "gamma")[:150],
        table_profile_that_swaps_red_and_blue()[:400],
    ],
)
def test_a_profile_that_cannot_be_used_is_named(rgb8, profile):
    with pytest.raises(UnreadablePicture, match=r"profile cannot be used .*; convert the file to sRGB"):
        srgb_from_profile(rgb8.astype(np.float32) / 255, profile)


def test_a_picture_of_billions_of_pixels_and_a_name_of_bytes_are_refused(tmp_path, monkeypatch):
    _, encoded = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "a.png").write_bytes(encoded.tobytes())
    name = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff.png"))
    name.write_bytes(encoded.tobytes())
    with pytest.raises(UnreadablePicture, match="the name of the file is not UTF-8"):
        read_picture(name)
    monkeypatch.setattr("polarnet.pictures.images.MAX_PIXELS", 63)
    with pytest.raises(UnreadablePicture, match="expected at most 63 pixels, got 8x8"):
        read_picture(tmp_path / "a.png")
