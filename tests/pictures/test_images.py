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
    read_light,
    read_picture,
    read_rgb,
    srgb_of,
    upright,
    write_png,
)

SRGB, LAB = (ImageCms.ImageCmsProfile(ImageCms.createProfile(space)).tobytes() for space in ("sRGB", "LAB"))


@pytest.fixture
def rgb8() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB code values of linear light in [0, 1] (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def reason(path: Path) -> str:
    with pytest.raises(UnreadablePicture) as caught:
        read_picture(path)
    return str(caught.value)


def test_a_16_bit_tiff_keeps_its_bits_alpha_is_dropped_and_equal_pixels_have_one_hash(tmp_path, rgb8):
    values = np.arange(65536, dtype=np.uint16)[::32][:1800].reshape(20, 30, 3)
    tifffile.imwrite(tmp_path / "deep.tif", values)
    picture = read_picture(tmp_path / "deep.tif")
    assert picture.bits == 16
    write_png(tmp_path / "deep.png", fit(picture.pixels, 20, 30, 1.0), picture.bits)
    assert np.array_equal(read_picture(tmp_path / "deep.png").pixels, values)
    half_transparent = np.dstack([rgb8, np.full((20, 30), 128, np.uint8)])
    Image.fromarray(half_transparent).save(tmp_path / "a.png")
    tifffile.imwrite(tmp_path / "a.tif", half_transparent, photometric="rgb", extrasamples=["unassalpha"])
    for name in ("a.png", "a.tif"):
        assert np.array_equal(read_picture(tmp_path / name).pixels, rgb8)
    Image.fromarray(rgb8).save(tmp_path / "a.png")
    assert np.array_equal(read_picture(str(tmp_path / "a.png")).pixels, rgb8)
    Image.fromarray(rgb8).save(tmp_path / "b.bmp")
    tifffile.imwrite(tmp_path / "c.tif", rgb8)
    assert len({read_picture(tmp_path / name).sha256 for name in ("a.png", "b.bmp", "c.tif")}) == 1


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
    for level in (-1.0, 3e38, 1e-42):
        tifffile.imwrite(tmp_path / f"{level}.tif", np.full((20, 30, 3), level, np.float32), photometric="rgb")
    content = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    chunk = struct.pack(">I4s", 12, b"iCCP") + b"x\0\0not a zlib"[:12]
    profile = chunk + struct.pack(">I", zlib.crc32(chunk[4:]))
    (tmp_path / "profile.png").write_bytes(content[:33] + profile + content[33:])
    for name, words in (
        ("text.png", "cannot be read: Not a PNG file"), ("empty.jpg", 'cannot be read: Empty file "empty.jpg"'),
        ("grey.tif", "one channel"), ("grey_alpha.png", "one channel"), ("a.dng", "camera raw"),
        ("nan.tif", "1 values are not finite numbers"), ("profile.png", "the embedded colour profile is damaged"),
        ("-1.0.tif", "expected floats with 1.0 as white"), ("3e+38.tif", "expected floats with 1.0 as white"),
        ("1e-42.tif", "expected floats with 1.0 as white"),
        ("missing.jpg", 'cannot be read: Could not open file "missing.jpg"'),
    ):  # fmt: skip
        assert reason(tmp_path / name).startswith(words)


def test_linear_light_in_an_exr_is_encoded_as_srgb_or_keeps_six_decades(tmp_path):
    linear = np.linspace(0, 1, 1800, dtype=np.float32).reshape(20, 30, 3)
    assert oiio.ImageBuf(linear).write(str(tmp_path / "a.exr"))
    rgb = read_rgb(tmp_path / "a.exr").permute(1, 2, 0).numpy()
    np.testing.assert_allclose(rgb, encode_srgb(linear), atol=1e-4)
    linear = np.geomspace(2e-5, 20, 1800, dtype=np.float32).reshape(20, 30, 3)
    assert oiio.ImageBuf(linear).write(str(tmp_path / "a.exr"))
    np.testing.assert_allclose(read_light(tmp_path / "a.exr").permute(1, 2, 0).numpy(), linear / 20, rtol=1e-6)
    Image.new("RGB", (30, 20)).save(tmp_path / "a.png")
    with pytest.raises(UnreadablePicture, match=r"expected linear light in floating-point numbers, .*, got uint8"):
        read_light(tmp_path / "a.png")


def test_the_centre_of_shape_3_to_2_is_kept_and_enlarging_has_a_limit():
    tall = np.zeros((90, 30, 3), np.uint8)
    tall[35:55] = 255  # the middle 20 rows of 90
    assert fit(tall, 20, 30, 1.0).min() == 1
    wide = np.zeros((20, 100, 3), np.uint8)
    wide[:, 35:65] = 255
    assert fit(wide, 20, 30, 1.0).min() == 1
    edge = np.zeros((10, 15, 3), np.uint8)
    edge[:, 7:] = 255
    enlarged = fit(edge, 20, 30, 2.0)
    assert enlarged.shape == (20, 30, 3)
    assert enlarged.min() == 0
    assert enlarged.max() == 1
    with pytest.raises(UnreadablePicture, match=r"too small: 15x10 pixels would be enlarged 2.00 times"):
        fit(edge, 20, 30, 1.9)


def test_extensions_name_pictures_and_too_large_ones_and_names_of_bytes_are_refused(tmp_path, monkeypatch):
    extensions = picture_extensions()
    assert {"jpg", "jpeg", "tif", "tiff", "png", "exr", "webp", "jxl", "dng", "heic"} <= extensions
    assert not {"null", "term", "z", "env", "txt", "csv"} & extensions
    _, encoded = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "a.png").write_bytes(encoded.tobytes())
    name = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff.png"))
    name.write_bytes(encoded.tobytes())
    with pytest.raises(UnreadablePicture, match="the name of the file is not UTF-8"):
        read_picture(name)
    monkeypatch.setattr("polarnet.pictures.images.MAX_PIXELS", 63)
    with pytest.raises(UnreadablePicture, match="expected at most 63 pixels, got 8x8"):
        read_picture(tmp_path / "a.png")


def test_a_photograph_in_adobe_rgb_is_converted_as_by_little_cms_and_an_srgb_profile_keeps_16_bits(tmp_path):
    path = Path(str(resources.files("skimage"))) / "data" / "rocket.jpg"
    stored = Image.open(path)
    device = ImageCms.ImageCmsProfile(io.BytesIO(stored.info["icc_profile"]))
    expected = np.asarray(ImageCms.profileToProfile(stored, device, ImageCms.createProfile("sRGB"))).astype(int)
    got = np.round(255 * read_rgb(path).permute(1, 2, 0).numpy()).astype(int)
    assert np.abs(got - expected).max() <= 1
    assert np.abs(got - np.asarray(stored).astype(int)).max() > 10
    ramp = np.repeat(np.arange(600, dtype=np.uint16).reshape(20, 30, 1) * 20 + 20000, 3, axis=2)
    tifffile.imwrite(tmp_path / "deep.tif", ramp, iccprofile=SRGB)
    assert len(np.unique(read_rgb(tmp_path / "deep.tif")[1])) == 600


@pytest.mark.parametrize("profile", [b"short", LAB, SRGB[:150], SRGB.replace(b"gTRC", b"none")])
def test_a_profile_that_cannot_be_used_is_named(rgb8, profile):
    with pytest.raises(UnreadablePicture, match=r"profile cannot be used .*; convert the file to sRGB"):
        srgb_of(rgb8.astype(np.float32) / 255, Picture(rgb8, profile, "", False, None, None))
