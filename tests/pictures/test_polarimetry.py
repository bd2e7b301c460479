"""Measured polarization: three ways to store it, one scene."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from polarnet.pictures.images import UnreadablePicture
from polarnet.pictures.ingest import IngestConfig, ingest
from polarnet.pictures.polarimetry import (
    Measurement,
    are_measurements,
    demosaic,
    group_by_measurement,
    parse_raw_mosaic,
    read_intensities,
    read_measurement,
    shrink,
    white_level,
)
from polarnet.simulation import MOTIONS, scene_from_intensities
from polarnet.simulation.truth import Synthesis, synthesize
from polarnet.stokes import aolp, dolp, parse_mosaic
from polarnet.storage import FrameStore, SceneStore

SONY = parse_mosaic("90 45 / 135 0")
ANGLES = (0, 45, 90, 135)
CONFIG = IngestConfig(
    source="polarization", root="", limit=None, dead_leaves=0, height=80, width=120, max_upscale=2.0, val_fraction=0.0,
    test_fraction=0.0, mosaic="90 45 / 135 0", white=None, residual_max=0.1,
)  # fmt: skip


def light(height: int = 40, width: int = 60, degree: float = 0.6, angle_deg: float = 30.0) -> np.ndarray:
    """I0, I45, I90, I135 of Eq. 4 as uint8: S0 rises from left to right, DoLP and AoLP are the same everywhere."""
    s0 = np.linspace(60, 200, width) * np.ones((height, 1))
    doubled = [2 * math.radians(angle - angle_deg) for angle in ANGLES]
    return np.stack([np.round(s0 / 2 * (1 + degree * math.cos(d))) for d in doubled]).astype(np.uint8)


def save_npz(path: Path, intensities: np.ndarray) -> None:
    np.savez(path, **{f"I{angle}": plane for angle, plane in zip(ANGLES, intensities, strict=True)})


def raw_mosaic(intensities: np.ndarray) -> np.ndarray:
    """Raw mosaic of a sensor in the Sony order."""
    raw = np.zeros(intensities.shape[1:], intensities.dtype)
    for row in (0, 1):
        for column in (0, 1):
            plane = intensities[ANGLES.index(SONY[row][column])]
            raw[row::2, column::2] = plane[row::2, column::2]
    return raw


def polarization_of(measurement: Measurement) -> tuple[torch.Tensor, torch.Tensor]:
    stokes = scene_from_intensities(torch.from_numpy(measurement.intensities)).stokes
    return dolp(stokes), aolp(stokes)


def reason(*files: Path) -> str:
    with pytest.raises(UnreadablePicture) as caught:
        read_measurement(files, SONY)
    return str(caught.value)


def test_three_ways_to_store_one_scene_give_its_polarization(tmp_path):
    intensities = light()
    save_npz(tmp_path / "scene.npz", intensities)
    for angle, plane in zip(ANGLES, intensities, strict=True):
        Image.fromarray(plane).save(tmp_path / f"scene_{angle}.png")
    Image.fromarray(raw_mosaic(intensities)).save(tmp_path / "raw.png")
    groups = group_by_measurement(sorted(tmp_path.iterdir()))
    assert sorted(len(group) for group in groups) == [1, 1, 4]
    for group in groups:
        measured = read_measurement(group, SONY)
        degree, angle = polarization_of(measured)
        assert degree.mean().item() == pytest.approx(0.6, abs=0.005)
        assert (degree - 0.6).abs().max() < 0.03  # 8 bits
        assert math.degrees(angle.mean()) == pytest.approx(30, abs=0.2)
        assert measured.valid.all()
        assert measured.residual < 0.01


def test_16_bit_files_and_colour_files_are_read_too(tmp_path):
    intensities = light()
    files = []
    for angle, plane in zip(ANGLES, intensities, strict=True):
        files.append(tmp_path / f"scene_{angle:03d}.tif")
        colour = np.stack([np.zeros_like(plane), plane, np.full_like(plane, 7)], axis=-1)  # green counts
        tifffile.imwrite(files[-1], colour.astype(np.uint16) * 257, photometric="rgb")
    save_npz(tmp_path / "scene.npz", intensities)
    as_files, as_npz = read_measurement(files, SONY), read_measurement([tmp_path / "scene.npz"], SONY)
    np.testing.assert_allclose(as_files.intensities, as_npz.intensities, atol=1e-6)


def test_saturated_light_is_found_by_its_bits_or_by_a_stated_white_level(tmp_path):
    save_npz(tmp_path / "a.npz", np.full((4, 8, 8), 254, np.uint8))
    s0 = scene_from_intensities(torch.from_numpy(read_measurement([tmp_path / "a.npz"], SONY).intensities)).stokes[0]
    assert s0.max().item() == pytest.approx(254 / 255)
    # DoLP 0.6 along 0 degrees at S0 = 6000: I0 was 4800, which 12 bits cut at 4095.
    levels = np.tile(np.array([4095, 3000, 1200, 3000]).reshape(4, 1, 1), (1, 8, 8))
    levels[:, 4:] = np.array([801, 501, 201, 501]).reshape(4, 1, 1)
    save_npz(tmp_path / "a.npz", (levels << 4).astype(np.uint16))
    measured = read_measurement([tmp_path / "a.npz"], SONY)
    assert polarization_of(measured)[0][0, 0].item() == pytest.approx(0.6, abs=1e-3)
    assert measured.saturated == 0.5
    # 16 times 12 bits with a dark level of 100 subtracted: no bit is spare, and the file saturates at 65420.
    save_npz(
        tmp_path / "a.npz", np.stack([np.full((8, 8), level, np.uint16) for level in (65420, 32710, 30000, 40000)])
    )
    assert not read_measurement([tmp_path / "a.npz"], SONY, white=65420.5).saturated
    with pytest.raises(UnreadablePicture, match="unsaturated"):
        read_measurement([tmp_path / "a.npz"], SONY, white=65420.0)
    with pytest.raises(UnreadablePicture, match=r"levels up to 65000, got 65420; .* ingest\.white or --white"):
        read_measurement([tmp_path / "a.npz"], SONY, white=65000.0)


@pytest.mark.parametrize(("bits", "width"), [(8, 16), (10, 16), (12, 16), (14, 16), (10, 12), (12, 12), (16, 16)])
@pytest.mark.parametrize("black", [0, 1, 37])
def test_bits_that_are_0_below_those_of_the_camera_do_not_raise_its_white(bits, width, black):
    levels = np.random.default_rng(1).integers(black, 2**bits, (4, 20, 30)).astype(np.uint16)
    levels[0, 0, 0] = 2**bits - 1
    assert white_level(levels << (width - bits)) == (2**bits - 1) << (width - bits)


def test_an_exif_orientation_turns_no_polarizer(tmp_path):
    """Turned upright by a quarter, light at 30 degrees would be at 120 or 60, and the cells of a mosaic would swap."""
    turned = Image.Exif()
    turned[0x0112] = 6
    for angle, plane in zip(ANGLES, light(), strict=True):
        Image.fromarray(plane).save(tmp_path / f"scene_{angle}.png", exif=turned)
    Image.fromarray(raw_mosaic(light())).save(tmp_path / "raw.png", exif=turned)
    for group in group_by_measurement(sorted(tmp_path.iterdir())):
        assert math.degrees(polarization_of(read_measurement(group, SONY))[1].mean()) == pytest.approx(30, abs=0.2)


def test_numbers_that_count_frames_are_no_angles(tmp_path):
    """frame_000, frame_001, ... are raw mosaics, each of its own, although some numbers are angles."""
    for number in range(136):
        Image.fromarray(raw_mosaic(light(12, 12))).save(tmp_path / f"frame_{number:03d}.png")
    groups = group_by_measurement(sorted(tmp_path.iterdir()))
    assert [len(group) for group in groups] == [1] * 136
    assert not are_measurements(groups)
    assert read_measurement(groups[45], SONY).valid.shape == (4, 4)


def test_one_saturated_angle_follows_from_the_others_and_shrinking_keeps_two_masked(tmp_path):
    values = np.full((4, 8, 8), 100, np.uint8)
    values[:, 2, 3] = (255, 220, 60, 130)  # I0 was 220 + 130 - 60 = 290
    values[:, 4, 5] = (255, 255, 60, 60)
    save_npz(tmp_path / "a.npz", values)
    measured = read_measurement([tmp_path / "a.npz"], SONY)
    assert measured.intensities[0, 2, 3] * 510 == pytest.approx(290)
    assert np.argwhere(~measured.valid).tolist() == [[4, 5]]
    assert measured.saturated == 2 / 64
    valid = np.ones((160, 240), dtype=bool)
    valid[80, 100] = False
    measured = Measurement(np.full((4, 160, 240), 0.25, np.float32), valid, residual=0.0, saturated=0.0)
    shrunk = shrink(measured, 80, 120)
    assert shrunk.valid.shape == (80, 120)
    assert np.argwhere(~shrunk.valid).tolist() == [[40, 50]]
    assert shrink(measured, 200, 300) is measured  # never enlarged


@pytest.mark.parametrize("order", ["90 45 / 135 0", "0 45 / 135 90", "135 0 / 90 45"])
def test_every_angle_of_a_mosaic_is_seen_at_the_centre_of_its_cell(order):
    """Bilinear interpolation is exact on planes: each angle has one of its own."""
    mosaic = parse_mosaic(order)
    rows, columns = np.mgrid[:20, :30].astype(float)
    plane = {0: rows, 45: columns, 90: 10 + rows - 2 * columns, 135: 3 * rows + columns}
    raw = np.zeros((20, 30))
    for row in (0, 1):
        for column in (0, 1):
            raw[row::2, column::2] = plane[mosaic[row][column]][row::2, column::2]
    at_angles = demosaic(raw, mosaic)
    assert at_angles.shape == (4, 8, 13)
    centre_rows, centre_columns = np.mgrid[1:9, 1:14] * 2 + 0.5
    expected = [centre_rows, centre_columns, 10 + centre_rows - 2 * centre_columns, 3 * centre_rows + centre_columns]
    np.testing.assert_allclose(at_angles, expected, atol=1e-12)


def test_what_does_not_belong_together_is_named(tmp_path):
    plane = light()[0]
    for name in ("a_0.png", "a_45.png", "a_90.png", "b_0.png", "b_45.png", "b_90.png", "b_135.png"):
        Image.fromarray(plane).save(tmp_path / name)
    Image.fromarray(plane[:-2]).save(tmp_path / "b_135.png")
    assert reason(*sorted(tmp_path.glob("a_*"))) == "no file for _135 beside a_0.png"
    assert "one size and type" in reason(*sorted(tmp_path.glob("b_*")))
    np.savez(tmp_path / "c.npz", I0=plane, I45=plane)
    assert reason(tmp_path / "c.npz") == "expected the arrays I0, I45, I90, I135, I90, I135 is missing"
    save_npz(tmp_path / "d.npz", light().astype(np.float32))
    assert reason(tmp_path / "d.npz").startswith("expected floats in [0, 1], got 1")
    (tmp_path / "e.npz").write_text("text")
    assert "cannot be read" in reason(tmp_path / "e.npz")
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "f.png")
    assert reason(tmp_path / "f.png").startswith("3 channels: neither a raw mosaic nor one of NAME_0")
    save_npz(tmp_path / "g.npz", np.full((4, 8, 8), 255, np.uint8))
    assert reason(tmp_path / "g.npz") == "no pixel is lit and unsaturated at all four angles"


MOTION = dataclasses.replace(
    MOTIONS["default"], duration_s=0.2, sensor_height=20, sensor_width=30, speed_min_px_s=30.0, speed_max_px_s=60.0,
    acceleration_max_px_s2=2000.0,
)  # fmt: skip


def test_saturated_pixels_stay_masked_down_to_the_frames(tmp_path):
    """A lamp of 8x8 pixels moves over the frames as up to 8x8 pixels, or 9 where it lies between them."""
    (tmp_path / "measured").mkdir()
    dark, lamp = light(), light()
    lamp[:, 16:24, 26:34] = 255
    save_npz(tmp_path / "measured" / "dark.npz", dark)
    save_npz(tmp_path / "measured" / "lamp.npz", lamp)
    manifest = ingest(dataclasses.replace(CONFIG, root=str(tmp_path / "measured")), 1, tmp_path / "images", map)
    share = {entry.origin: entry.masked_fraction for entry in manifest.pictures}
    assert sorted(share.values()) == [0, pytest.approx(64 / (40 * 60), abs=1e-6)]
    synthesize(Synthesis(tmp_path / "images", MOTION, 1, 2), tmp_path / "scenes.zarr", tmp_path / "frames.zarr", map)
    scenes, frames = SceneStore.open(tmp_path / "scenes.zarr"), FrameStore.open(tmp_path / "frames.zarr")
    masked = {name: ~frames.frames(name).valid for name in frames.sequences}
    (shown,) = (name for name in masked if masked[name].any())
    assert sum(map(torch.Tensor.any, masked.values())) == 1  # the dark one has a mask too, of nothing
    assert torch.equal(~scenes.read(shown).valid, torch.from_numpy(lamp.min(axis=0) == 255))
    for frame in masked[shown]:
        rows, columns = frame.any(1).sum().item(), frame.any(0).sum().item()
        assert frame.sum().item() == rows * columns
        assert max(rows, columns) <= 9
    assert frames.frames(shown).dolp[~masked[shown]].mean().item() == pytest.approx(0.6, abs=0.005)


def test_a_measurement_is_taken_and_one_with_exchanged_angles_is_skipped(tmp_path):
    """40x60 is smaller than 80x120 and used as it is."""
    (tmp_path / "measured").mkdir()
    save_npz(tmp_path / "measured" / "glass.npz", light())
    wrong = light()[[1, 0, 2, 3]]  # 0 and 45 degrees swapped
    save_npz(tmp_path / "measured" / "mislabelled.npz", wrong)
    manifest = ingest(dataclasses.replace(CONFIG, root=str(tmp_path / "measured")), 1, tmp_path / "images", map)
    (entry,) = manifest.pictures
    assert (entry.file, entry.height, entry.width) == (f"{entry.name}.npz", 40, 60)
    assert entry.residual < 0.01
    assert entry.masked_fraction == entry.saturated_fraction == 0
    (skipped,) = manifest.skipped
    # I45 + I90 - I0 - I135 over S0, for 30 degrees: 0.6 (cos 30 + cos 120 - cos 60 - cos 210) / 2 = 0.22
    assert "the angles do not fit: the median of |I0 + I90 - I45 - I135| / S0 is 0.2" in skipped.reason


@pytest.mark.shared
def test_measured_samples_are_taken_with_the_residuals_their_notes_state(shared, tmp_path):
    """1 to 3 % (FORMATS.md); camera 1 %, carps 4 % of raw pixels saturated; the other mosaic order does not fit."""
    config = dataclasses.replace(CONFIG, root=str(shared / "data" / "polarization"), height=400, width=600)
    manifest = ingest(config, 1, tmp_path / "images", map)
    by_name = {entry.origin: entry for entry in manifest.pictures}
    assert len(by_name) == 4
    assert all(0.01 < entry.residual < 0.03 for entry in by_name.values())
    assert (by_name["carps_IMX250MZR.png"].height, by_name["carps_IMX250MZR.png"].width) == (400, 600)
    assert by_name["wan_Scene2_LT.npz"].height == 420
    intensities, valid = read_intensities(tmp_path / "images" / by_name["carps_IMX250MZR.png"].file)
    assert 0.5 < dolp(scene_from_intensities(intensities).stokes)[valid].median() < 0.6  # light reflected by water
    other = ingest(dataclasses.replace(config, mosaic="0 45 / 90 135"), 1, tmp_path / "other", map)
    assert [skipped.file for skipped in other.skipped] == ["carps_IMX250MZR.png"]


def test_a_colour_mosaic_counts_its_green_pixels_where_all_angles_agree():
    mosaic, colours = parse_raw_mosaic("RGGB 90 45 / 135 0")
    assert (mosaic, colours) == (((90, 45), (135, 0)), "RGGB")
    assert parse_raw_mosaic("90 45 / 135 0") == (mosaic, None)
    y, x = np.mgrid[:24, :32].astype(np.float64)
    raw = np.full((24, 32), 1e6)  # red and blue must not matter
    slopes = {0: (60, 2, 1), 45: (90, 1, 2), 90: (100, 1, 0), 135: (70, 2, -1)}
    for row in (0, 1):
        for column in (0, 1):
            level, across, down = slopes[mosaic[row][column]]
            green = ((y // 2 + x // 2) % 2 == 1) & (y % 2 == row) & (x % 2 == column)
            raw[green] = (level + across * x + down * y)[green]
    planes = demosaic(raw, mosaic, colours)
    assert planes.shape == (4, 4, 6)
    centre_y, centre_x = np.mgrid[4:20:4, 4:28:4] + 1.5
    for plane, (level, across, down) in zip(planes, slopes.values(), strict=True):
        np.testing.assert_allclose(plane, level + across * centre_x + down * centre_y)
    with pytest.raises(ValueError, match="mosaic: expected the angles"):
        parse_raw_mosaic("RGBG 90 45 / 135 0")
