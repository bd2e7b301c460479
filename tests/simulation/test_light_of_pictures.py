"""Photographs of linear light over six decades, from the file to the events and their truth."""

from dataclasses import replace

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from polarnet.config.tree import load
from polarnet.pictures.ingest import ingest
from polarnet.pictures.manifest import read_manifest
from polarnet.simulation.camera import Camera
from polarnet.simulation.dataset import emulate_scenes, motion_over
from polarnet.simulation.presets import MOTIONS, SENSORS
from polarnet.simulation.scene import LIGHT_RANGE, logarithmic, scene_from_light, scene_from_polarization, stretched
from polarnet.simulation.truth import Synthesis, synthesize
from polarnet.stokes import aolp, dolp
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.scenes import SceneStore

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
    assert entry.bits == (32 if fires else 8)
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


def test_the_polarization_of_dark_light_is_that_of_bright_light():
    light = torch.rand(3, 6, 8, generator=torch.Generator().manual_seed(1)) * 0.9 + 0.1
    bright, dark = scene_from_light(light).stokes, scene_from_light(light * 1e-6).stokes
    torch.testing.assert_close(dark, bright * 1e-6, rtol=1e-5, atol=1e-12)
    assert dolp(dark).max() > 0.5
    assert aolp(dark).max() > 2
    assert scene_from_light(torch.zeros(3, 1, 1)).stokes.tolist() == [[[0.0]]] * 3


def test_the_logarithm_of_light_is_stretched_to_the_light():
    s0 = torch.logspace(-8, 0, 40).view(4, 10)
    scene = scene_from_polarization(logarithmic(s0, LIGHT_RANGE), torch.full((4, 10), 0.3), torch.zeros(4, 10))
    torch.testing.assert_close(stretched(scene, LIGHT_RANGE).stokes[0], s0, rtol=1e-4, atol=0)
    assert logarithmic(torch.zeros(1, 1), LIGHT_RANGE) == 0
