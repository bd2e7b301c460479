"""The stage in between: pictures in, scenes, trajectories and exact frames out."""

import dataclasses
import functools
import logging
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from part_fixtures import files_of
from PIL import Image
from simulation_fixtures import REST, STILL

from polarnet.config.tree import load
from polarnet.pictures.ingest import IngestConfig, ingest
from polarnet.pictures.manifest import read_manifest, write_manifest
from polarnet.runtime.cluster import pmap
from polarnet.simulation.camera import IDEAL, Grid, grid, weights_of
from polarnet.simulation.dataset import emulate_scenes
from polarnet.simulation.motion import SynthesizeConfig, Trajectory, frame_times_us, random_trajectory, render
from polarnet.simulation.moving_sensor import channel_light
from polarnet.simulation.presets import MOTIONS
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization, scene_from_rgb
from polarnet.simulation.truth import Synthesis, frames_of, synthesize, valid_frames
from polarnet.stokes import aolp, dolp, stokes_from_intensities
from polarnet.storage.frames import FrameStore
from polarnet.storage.scenes import SceneStore
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


def test_every_picture_gets_its_sequences_and_all_of_them_its_split(stores):
    scenes, frames = stores
    assert len(scenes.sequences) == len(frames.sequences) == 10
    assert [len(frames.of_split(split)) for split in ("train", "val", "test")] == [6, 2, 2]
    for split in ("train", "val", "test"):
        assert frames.of_split(split) == scenes.of_split(split)


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


def test_the_stored_truth_is_what_the_stored_scene_and_trajectory_show(stores):
    scenes, frames = stores
    t_us = frame_times_us(CONFIG)
    for sequence in scenes.sequences[:3]:
        record = scenes.read(sequence)
        scene = scene_from_polarization(record.s0, record.dolp, record.aolp)
        trajectory = Trajectory.from_vector(scenes.trajectory(sequence))
        intensity, degree, angle = frames_of(scene, trajectory, t_us, 24, 36)
        stored = frames.frames(sequence)
        assert stored.t_us.tolist() == t_us
        torch.testing.assert_close(stored.intensity, intensity, atol=1 / 65535, rtol=0)
        torch.testing.assert_close(stored.dolp, degree, atol=1 / 65535, rtol=0)
        turn = (stored.aolp - angle + torch.pi / 2) % torch.pi - torch.pi / 2
        assert turn.abs().max() <= torch.pi / 65536


def test_the_truth_follows_from_the_four_intensities_by_equations_1_to_3(stores):
    _, frames = stores
    truth = frames.frames(frames.sequences[0])
    stokes = stokes_from_intensities(truth.intensity)
    bright = stokes[:, 0] > 0.2
    torch.testing.assert_close(dolp(stokes)[bright], truth.dolp[bright], atol=3e-4, rtol=0)
    polarized = bright & (truth.dolp > 0.3)
    turn = (aolp(stokes) - truth.aolp + torch.pi / 2) % torch.pi - torch.pi / 2
    assert turn[polarized].abs().max() < 1e-3


def killed(images: Path, folder: Path, parts: int) -> None:
    """A run that dies after some parts."""

    def dies(function, items):
        for item in items[:parts]:
            function(item)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(images, folder, mapper=dies)
    assert not (folder / "frames.zarr").exists()


def parts_made_by(images: Path, folder: Path, config: SynthesizeConfig = CONFIG) -> int:
    made = []
    run(images, folder, config, lambda function, items: made.extend(items) or [function(item) for item in items])
    return len(made)


def test_a_run_killed_half_way_ends_with_the_same_bytes(images, stores, tmp_path):
    killed(images, tmp_path, parts=2)
    assert parts_made_by(images, tmp_path) == 3
    for name in ("scenes.zarr", "frames.zarr"):
        assert files_of(tmp_path / name) == files_of(Path(stores[0].path).parent / name)


def test_another_setting_is_not_mixed_with_what_an_interrupted_run_left(images, tmp_path):
    killed(images, tmp_path, parts=1)
    assert parts_made_by(images, tmp_path, dataclasses.replace(CONFIG, speed_min_px_s=150.0)) == 5


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        (7.5, 5.5, [(4, 3)]),  # on the scene's pixels: one pixel shows the masked one
        (7.75, 5.5, [(4, 2), (4, 3)]),  # between columns: two mix with it
        (7.5, 5.75, [(3, 3), (4, 3)]),
        (7.75, 5.75, [(3, 2), (3, 3), (4, 2), (4, 3)]),
    ],
)
def test_a_pixel_is_valid_unless_its_interpolation_uses_a_masked_one(x, y, expected):
    valid = torch.ones(12, 16, dtype=torch.bool)
    valid[7, 8] = False
    trajectory = Trajectory(x, y, REST, REST, STILL, STILL, speed_px_s=1.0)
    (seen,) = valid_frames(valid, trajectory, [0], Grid(6, 6))  # its first pixel looks at (x, y) - 2.5
    assert [tuple(place) for place in (~seen).nonzero().tolist()] == expected


def test_the_mask_of_a_turning_window_is_that_of_its_weights():
    """Light from masked pixels alone: what a valid pixel shows does not change when they do."""
    generator = torch.Generator().manual_seed(1)
    light = torch.rand(3, 60, 80, generator=generator)
    valid = torch.rand(60, 80, generator=generator) < 0.98
    trajectory = random_trajectory(CONFIG, 60, 80, np.random.default_rng(4))
    rendered = valid_frames(valid, trajectory, [0, 50_000, 100_000], Grid(24, 36))
    t_s = np.array([0, 0.05, 0.1])
    changed = torch.where(valid, light, light + 1)
    before, after = (render(PolarizationScene(planes), trajectory, t_s, 24, 36)[:, 0] for planes in (light, changed))
    assert torch.equal(rendered, before == after)
    assert 0.8 < rendered.float().mean() < 0.98


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


def test_the_number_of_threads_changes_no_bit_of_a_frame():
    config = dataclasses.replace(CONFIG, sensor_height=121, sensor_width=179, duration_s=0.4)
    generator = np.random.default_rng(0)
    s0, degree, angle = torch.rand(3, 300, 400, generator=torch.Generator().manual_seed(0))
    scene = scene_from_polarization(s0, degree, math.pi * angle)
    trajectory = random_trajectory(config, 300, 400, generator)

    def frames(threads):
        torch.set_num_threads(threads)
        on_sensor = frames_of(scene, trajectory, frame_times_us(config), 121, 179)
        assert torch.get_num_threads() == threads
        return on_sensor

    for one, several in zip(frames(1), frames(3), strict=True):
        assert torch.equal(one, several)


def test_the_truth_of_a_mosaic_is_that_of_the_centres_of_its_cells():
    """Each cell's truth is the mean of the four pixels' Stokes parameters where the sensor stands on whole pixels."""
    generator = torch.Generator().manual_seed(3)
    scene = scene_from_polarization(*torch.rand(3, 40, 60, generator=generator))
    trajectory = Trajectory(29.5, 19.5, REST, REST, STILL, STILL, 0.0)
    rows, columns, pitch = grid("dofp", 20, 30)
    intensities, degree, _ = frames_of(scene, trajectory, [0], rows, columns, pitch)
    cells = torch.nn.functional.avg_pool2d(scene.stokes[None, :, 10:30, 15:45], 2)[0]
    assert intensities.shape == (1, 4, 10, 15)
    torch.testing.assert_close(degree[0], dolp(cells), atol=1e-5, rtol=0)


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
