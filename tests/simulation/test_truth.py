"""From pictures to scenes, trajectories and exact frames, and from linear light over six decades to its events."""

import dataclasses
import functools
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from part_fixtures import files_of
from PIL import Image

from polarnet.config.tree import load
from polarnet.pictures.ingest import IngestConfig, ingest
from polarnet.pictures.manifest import read_manifest, write_manifest
from polarnet.runtime.cluster import pmap
from polarnet.simulation import MOTIONS, SENSORS, Camera, PolarizationScene, scene_from_polarization, scene_from_rgb
from polarnet.simulation.camera import IDEAL, Grid, weights_of
from polarnet.simulation.motion import SynthesizeConfig, Trajectory, frame_times_us, random_trajectory, render
from polarnet.simulation.moving_sensor import channel_light
from polarnet.simulation.scene import LIGHT_RANGE, logarithmic, scene_from_light, stretched
from polarnet.simulation.sets import emulate_scenes, motion_over
from polarnet.simulation.truth import Synthesis, frames_of, synthesize, valid_frames
from polarnet.stokes import aolp, dolp, stokes_from_intensities
from polarnet.storage import EventStore, FrameStore, SceneStore
from studies.robustness import sequence_at

SEQUENCES_PER_PART = 2
CONFIG = dataclasses.replace(
    MOTIONS["default"], sequences_per_picture=2, duration_s=0.2, sensor_height=24, sensor_width=36, speed_min_px_s=60.0,
    speed_max_px_s=200.0, acceleration_max_px_s2=2000.0, rotation_max_deg=10.0, zoom_max=1.2,
)  # fmt: skip


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("ingested")
    (root / "pictures").mkdir()
    for i in range(5):
        coarse = Image.fromarray(np.random.default_rng(i).integers(0, 256, (6, 8, 3), dtype=np.uint8))
        coarse.resize((120, 80), Image.Resampling.BICUBIC).save(root / "pictures" / f"{i}.png")
    config = IngestConfig(
        source="folder", root=str(root / "pictures"), limit=None, dead_leaves=0, height=80, width=120, max_upscale=2.0,
        val_fraction=0.2, test_fraction=0.2, mosaic="90 45 / 135 0", white=None, residual_max=0.1,
    )  # fmt: skip
    logging.disable(logging.WARNING)
    ingest(config, 1, root / "images", map)
    logging.disable(logging.NOTSET)
    return root / "images"


def run(images: Path, folder: Path, config: SynthesizeConfig = CONFIG, mapper=map) -> tuple[SceneStore, FrameStore]:
    synthesize(Synthesis(images, config, 1, SEQUENCES_PER_PART), folder / "scenes.zarr", folder / "frames.zarr", mapper)
    return SceneStore.open(folder / "scenes.zarr"), FrameStore.open(folder / "frames.zarr")


@pytest.fixture(scope="module")
def stores(images, tmp_path_factory) -> tuple[SceneStore, FrameStore]:
    return run(images, tmp_path_factory.mktemp("stores"))


def test_the_stored_truth_of_each_picture_is_that_of_its_scene_and_follows_equations_1_to_3(stores):
    scenes, frames = stores
    assert len(scenes.sequences) == len(frames.sequences) == 10
    assert [len(frames.of_split(split)) for split in ("train", "val", "test")] == [6, 2, 2]
    for split in ("train", "val", "test"):
        assert frames.of_split(split) == scenes.of_split(split)
    t_us = frame_times_us(CONFIG)
    for sequence in scenes.sequences[:3]:
        record = scenes.read(sequence)
        scene = scene_from_polarization(record.s0, record.dolp, record.aolp)
        trajectory = Trajectory.from_record(scenes.record(sequence)["trajectory"])
        intensity, degree, angle = frames_of(scene, trajectory, t_us, 24, 36)
        stored = frames.frames(sequence)
        assert stored.t_us.tolist() == t_us
        torch.testing.assert_close(stored.intensity, intensity, atol=1 / 65535, rtol=0)
        torch.testing.assert_close(stored.dolp, degree, atol=1 / 65535, rtol=0)
        turn = (stored.aolp - angle + torch.pi / 2) % torch.pi - torch.pi / 2
        assert turn.abs().max() <= torch.pi / 65536
    truth = frames.frames(frames.sequences[0])
    stokes = stokes_from_intensities(truth.intensity)
    bright = stokes[:, 0] > 0.2
    torch.testing.assert_close(dolp(stokes)[bright], truth.dolp[bright], atol=3e-4, rtol=0)
    polarized = bright & (truth.dolp > 0.3)
    turn = (aolp(stokes) - truth.aolp + torch.pi / 2) % torch.pi - torch.pi / 2
    assert turn[polarized].abs().max() < 1e-3


def test_each_training_sequence_over_a_variant_names_its_picture(images, stores, tmp_path, project_root):
    variation = dataclasses.replace(load(project_root).variation, scenes_per_picture=1)
    paths = tmp_path / "scenes.zarr", tmp_path / "frames.zarr"
    synthesize(Synthesis(images, CONFIG, 1, SEQUENCES_PER_PART, variation), *paths, map)
    scenes, frames = SceneStore.open(paths[0]), FrameStore.open(paths[1])
    assert frames.variant_of == scenes.variant_of
    assert sorted(scenes.variant_of.values()) == sorted(
        stores[0].scene_of[name] for name in stores[0].of_split("train")
    )
    assert set(scenes.sequences) - set(scenes.variant_of) == set(stores[0].sequences)
    variant, picture = next(iter(scenes.variant_of.items()))
    assert scenes.scene_of[variant] == f"{picture}-variant01"
    assert not torch.equal(scenes.read(variant).aolp, scenes.read(f"{picture}-00").aolp)


def test_pictures_too_small_for_the_window_are_left_out(images, stores, tmp_path, caplog):
    smaller = tmp_path / "images"
    shutil.copytree(images, smaller)
    manifest = read_manifest(smaller)
    first, *others = manifest.pictures
    write_manifest(dataclasses.replace(manifest, pictures=(dataclasses.replace(first, height=24), *others)), smaller)
    scenes, frames = run(smaller, tmp_path)
    assert f"skipped {first.origin}: a scene of 24x120 (height x width) is too small" in caplog.text
    assert set(scenes.scene_of.values()) == {entry.name for entry in others}
    for sequence in scenes.sequences:
        assert frames.frames(sequence).dolp.equal(stores[1].frames(sequence).dolp)
    with pytest.raises(ValueError, match=r"none of 5 pictures can be used:\n  .*: a scene of 80x120 .* is too small"):
        run(images, tmp_path / "none", dataclasses.replace(CONFIG, sensor_height=80))
    assert not (tmp_path / "none").exists()


def test_a_run_killed_half_way_makes_the_missing_parts_and_ends_with_the_same_bytes(images, stores, tmp_path):
    made = []

    def dies(function, items):
        made.extend(map(function, items[:2]))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(images, tmp_path, mapper=dies)
    assert not (tmp_path / "frames.zarr").exists()
    run(images, tmp_path, mapper=lambda function, items: made.extend(items) or [function(item) for item in items])
    assert len(made) == 5
    for name in ("scenes.zarr", "frames.zarr"):
        assert files_of(tmp_path / name) == files_of(Path(stores[0].path).parent / name)


@pytest.mark.parametrize("crosstalk", [0.0, 0.2])
def test_a_cell_is_valid_unless_its_truth_or_light_changes_with_masked_pixels(crosstalk):
    polarizers = dataclasses.replace(IDEAL, layout="dofp", crosstalk=crosstalk)
    light = scene_from_rgb(torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(1))).stokes
    valid = torch.ones(60, 80, dtype=torch.bool)
    valid[5::9, 4::9] = False
    trajectory = random_trajectory(CONFIG, 60, 80, np.random.default_rng(4))

    def seen(planes):
        scene, t_s = PolarizationScene(planes), np.array([0, 0.05, 0.1])
        sensor = render(scene, trajectory, t_s, 24, 36).transpose(0, 1).numpy()
        cells = channel_light(sensor, polarizers, weights_of(polarizers, 24, 36, 0))
        return torch.cat([torch.from_numpy(cells).transpose(0, 1), render(scene, trajectory, t_s, 12, 18, 2)], dim=1)

    changed = (seen(light) != seen(torch.where(valid, light, light + torch.eye(3, 1)[..., None]))).any(dim=1)
    assert torch.equal(valid_frames(valid, trajectory, [0, 50_000, 100_000], Grid(12, 18, 2), crosstalk), ~changed)
    assert 0.1 < changed.float().mean() < 0.9


def test_truth_at_any_time_is_that_of_the_stretched_scene(images, tmp_path):
    synthesis = Synthesis(images, dataclasses.replace(CONFIG, dynamic_range=1000.0), 1, SEQUENCES_PER_PART)
    synthesize(synthesis, tmp_path / "scenes", tmp_path / "frames", map)
    scenes, frames = SceneStore.open(tmp_path / "scenes"), FrameStore.open(tmp_path / "frames")
    name = scenes.sequences[0]
    result = sequence_at(scenes, name, [], frames.t_us(name))
    torch.testing.assert_close(result.dolp, frames.frames(name, 1).dolp, atol=1e-4, rtol=0)


def test_a_log_shows_the_progress_inside_a_part_of_a_store(images, simulated, tmp_path, progress_log):
    synthesis, mapper = Synthesis(images, CONFIG, 1, SEQUENCES_PER_PART), functools.partial(pmap, workers=1)
    synthesize(synthesis, tmp_path / "scenes", tmp_path / "frames", functools.partial(mapper, label="synthesize"))
    emulate = functools.partial(mapper, label="emulate")
    emulate_scenes(simulated.scenes, tmp_path / "events", simulated.camera, simulated.seed, emulate, 1)
    lines = progress_log()
    for label, parts in (("synthesize", 5), ("emulate", 2)):
        assert any(line.startswith(f"{label}: ") and f"| 0.5/{parts} [" in line for line in lines), lines


MOTION = replace(
    MOTIONS["default"], duration_s=0.2, sensor_height=24, sensor_width=36, speed_min_px_s=60.0, speed_max_px_s=200.0,
    acceleration_max_px_s2=2000.0,
)  # fmt: skip
HEIGHT, WIDTH, DOLP = 80, 120, 0.4


def dark_picture() -> np.ndarray:
    """A reddish texture of 1e-6 to 2e-5 of the brightest light, which shines on one pixel in a corner."""
    coarse = np.random.default_rng(1).uniform(np.log(1e-6), np.log(2e-5), (8, 12)).astype(np.float32)
    level = np.exp(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR))
    light = level[..., None] * np.array([1, 1 - DOLP, 1 - DOLP], np.float32)
    light[0, 0] = 1
    return light


def write(path, light: np.ndarray) -> None:
    if path.suffix == ".png":
        cv2.imwrite(str(path), np.round(255 * light[..., ::-1]).astype(np.uint8))
    else:
        assert oiio.ImageBuf(1e6 * light).write(str(path)), oiio.geterror()  # its scale is free, as in cd/m²


@pytest.mark.parametrize(("suffix", "fires"), [(".exr", True), (".hdr", True), (".png", False)])
def test_the_pipeline_sees_the_dark_part_of_a_photograph_of_six_decades(project_root, tmp_path, suffix, fires):
    config = load(project_root)
    (tmp_path / "pictures").mkdir()
    write(tmp_path / "pictures" / f"night{suffix}", dark_picture())
    images, scenes, frames, events = (tmp_path / name for name in ("images", "scenes", "frames", "events"))
    taken = replace(
        config.ingest, source="folder", root=str(tmp_path / "pictures"), height=HEIGHT, width=WIDTH, val_fraction=0.0,
        test_fraction=0.0,
    )  # fmt: skip
    ingest(taken, 1, images, map)
    (entry,) = read_manifest(images).pictures
    assert Path(entry.file).suffix == (".npy" if fires else ".png")
    synthesize(Synthesis(images, MOTION, 1, 8, config.variation), scenes, frames, map)
    camera = Camera(replace(SENSORS["clean"], dark_dn=0.0))
    emulate_scenes(scenes, events, camera, 1, map, threads=1)
    store, truth = EventStore.open(events), FrameStore.open(frames)
    counts = [sum(map(len, store.read(sequence))) for sequence in store.sequences]
    assert len(counts) == 2  # the picture, and its variant of other light
    assert counts[0] > 1000 if fires else max(counts) == 0, counts
    if fires:
        original = truth.frames(store.sequences[0])
        assert original.dolp.numpy() == pytest.approx(DOLP, abs=0.01 if suffix == ".hdr" else 0.001)
        scene, *_ = motion_over(SceneStore.open(scenes), store.sequences[0])
        light = torch.from_numpy(dark_picture()).amax(dim=-1)
        torch.testing.assert_close(scene.stokes[0], light, rtol=0.01 if suffix == ".hdr" else 2e-4, atol=0)


def test_dark_light_is_polarized_like_bright_light_and_its_logarithm_is_stretched_to_it():
    light = torch.rand(3, 6, 8, generator=torch.Generator().manual_seed(1)) * 0.9 + 0.1
    bright, dark = scene_from_light(light).stokes, scene_from_light(light * 1e-6).stokes
    torch.testing.assert_close(dark, bright * 1e-6, rtol=1e-5, atol=1e-12)
    assert dolp(dark).max() > 0.5
    assert aolp(dark).max() > 2
    assert scene_from_light(torch.zeros(3, 1, 1)).stokes.tolist() == [[[0.0]]] * 3
    s0 = torch.logspace(-8, 0, 40).view(4, 10)
    scene = scene_from_polarization(logarithmic(s0, LIGHT_RANGE), torch.full((4, 10), 0.3), torch.zeros(4, 10))
    torch.testing.assert_close(stretched(scene, LIGHT_RANGE).stokes[0], s0, rtol=1e-4, atol=0)
    assert logarithmic(torch.zeros(1, 1), LIGHT_RANGE) == 0
