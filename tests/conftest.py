"""What several test modules share."""

import dataclasses
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

torch.set_num_threads(1)  # tests run side by side; threads that wait for each other would only slow them down


def pytest_runtest_setup() -> None:
    """Undo what `polarnet.runtime.tune`, called by an earlier test, leaves on: hypothesis wants numbers below 1e-38."""
    torch.set_flush_denormal(False)


@pytest.fixture(scope="session")
def project_root() -> Path:
    return Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared() -> Path:
    """The reference material, for the tests that compare with it; they skip where it is not."""
    folder = os.environ.get("POLARNET_SHARED")
    if not folder:
        pytest.skip("POLARNET_SHARED is not set: no reference material to compare with")
    return Path(folder)


class Simulated(NamedTuple):
    """Four short sequences, and what their events were made with."""

    scenes: Path
    frames: Path
    events: Path
    emulate: Any
    seed: int


@pytest.fixture(scope="session")
def simulated(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """Scenes of smooth noise, frames and events of a sensor that differs from sequence to sequence and is noisy."""
    from polarnet.config import load  # here, after pytest has installed jaxtyping's import hook
    from polarnet.events.frames import FrameStore
    from polarnet.simulation.dataset import emulate_scenes
    from polarnet.simulation.motion import Trajectory, frame_times_us, random_trajectory
    from polarnet.simulation.scene import scene_from_polarization
    from polarnet.simulation.scenes import SceneStore
    from polarnet.simulation.truth import frames_of

    folder = tmp_path_factory.mktemp("simulated")
    config = load(project_root)
    motion = dataclasses.replace(
        config.synthesize, duration_s=0.2, window_height=18, window_width=24, acceleration_max_px_s2=4000.0
    )
    emulate = dataclasses.replace(config.emulate, randomise=True, random_shot_noise_rate_hz=[20.0, 40.0])
    splits = {"a-0": "train", "b-0": "train", "c-0": "train", "d-0": "val"}
    window, t_us = (motion.window_height, motion.window_width), frame_times_us(motion)
    scenes = SceneStore.create(
        folder / "scenes.zarr",
        {name: name[0] for name in splits},
        splits,
        largest_picture=(60, 80),
        sensor=window,
        trajectory_names=Trajectory.vector_names(),
        attributes={},
    )
    frames = FrameStore.create(folder / "frames.zarr", list(splits), splits, len(t_us), *window, {})
    for number, (name, picture) in enumerate(scenes.picture_of.items()):
        generator = np.random.default_rng(number)
        coarse = torch.from_numpy(generator.random((1, 3, 12, 16), dtype=np.float32))
        s0, dolp, fraction = torch.nn.functional.interpolate(coarse, (60, 80), mode="bilinear")[0]
        trajectory = random_trajectory(motion, 60, 80, generator)
        scenes.write_picture(picture, s0, dolp, 3.14 * fraction)
        scenes.write(name, torch.from_numpy(trajectory.to_vector()), t_us[-1])
        record = scenes.read(name)
        scene = scene_from_polarization(record.s0, record.dolp, record.aolp)
        frames.write(name, torch.tensor(t_us), *frames_of(scene, trajectory, t_us, *window))
    scenes.finish()
    frames.finish()
    emulate_scenes(folder / "scenes.zarr", folder / "events.zarr", emulate, 3, map, 1)
    return Simulated(folder / "scenes.zarr", folder / "frames.zarr", folder / "events.zarr", emulate, 3)
