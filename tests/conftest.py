"""Fixtures and settings of several test modules."""

import dataclasses
import gc
import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

HERE = Path(__file__).parent
FIRST = (
    "simulation/test_emulator.py",
    "pipeline/test_dvc.py",
    "pipeline/test_stages.py",
    "training/test_loop.py",
    "benchmark/test_benchmark.py",
    "networks/test_onnx_export.py",
    "methods/test_methods.py",
    "config/test_config.py",
    "config/test_origins.py",
    "cli/test_simulate.py",
    "recordings/test_fuzz.py",
    "recovery/test_recover.py",
    "cli/test_benchmark_command.py",
    "benchmark/test_recorded.py",
    "reference/test_golden.py",
    "captures/test_rig.py",
    "characterization/test_fit.py",
)
"""Files that workers take first: one compiles the pixel models, the next eight need none of them, then the slowest.

So no two workers compile one kernel at once, and none is left with a long file when the rest is done.
"""
LARGE_PACKAGES = (
    "torch", "scipy.stats", "numba", "cv2", "zarr", "matplotlib.figure", "hydra", "pydantic.dataclasses", "ruamel.yaml",
    "jinja2",
)  # fmt: skip
FUZZ_CASES = {"local": 50, "ci": 150}


def pytest_collection() -> None:
    """Choose how many cases hypothesis tries, and import what every worker needs.

    Large packages come before polarnet: the import hook of jaxtyping renames the bytecode files of whatever a module of
    polarnet imports first, so Python would compile those packages once more.
    """
    import yaml  # here and not above, because the controller of several workers needs none of this
    from hypothesis import settings

    yaml.SafeLoader = yaml.CSafeLoader  # with which omegaconf reads params.yaml for every test that loads it
    os.fsync = lambda handle: None  # no test cuts the power, and each would wait a hundredth of a second
    gc.disable()  # what collection makes lives to the end, and looking through it for garbage takes seconds
    for name, cases in FUZZ_CASES.items():
        settings.register_profile(name, max_examples=cases, deadline=None)
    settings.load_profile("ci" if os.environ.get("CI") else "local")
    if "PYTEST_XDIST_WORKER" in os.environ:
        for package in LARGE_PACKAGES:
            importlib.import_module(package)


def pytest_collection_finish() -> None:
    """Collect no garbage of what the modules made."""
    gc.freeze()
    gc.enable()


def pytest_unconfigure() -> None:
    gc.unfreeze()  # else nanobind reports at exit what was never collected


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put `FIRST` first; `--dist loadfile` hands files out in this order."""
    order = {HERE / name: place for place, name in enumerate(FIRST)}
    missing = [str(path) for path in order if not path.exists()]
    if missing:
        raise pytest.UsageError(f"FIRST in {__file__} names files that are not there: {', '.join(missing)}")
    items.sort(key=lambda item: order.get(item.path, len(order)))


def pytest_runtest_setup() -> None:
    """Undo what a stage that an earlier test ran in this process has set (`polarnet.runtime.machine.configure`).

    Tests run side by side, so each has one thread; hypothesis wants numbers below 1e-38.
    """
    import torch

    torch.set_num_threads(1)
    torch.set_flush_denormal(False)
    torch.use_deterministic_algorithms(False)


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


@pytest.fixture(scope="session")
def make_events() -> Callable:
    from event_fixtures import events_of

    return events_of


@pytest.fixture(scope="session")
def make_random_events() -> Callable:
    from event_fixtures import random_events

    return random_events


@pytest.fixture(scope="session")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    from method_fixtures import write_checkpoints

    return write_checkpoints(tmp_path_factory.mktemp("checkpoints"))


@pytest.fixture
def unchecked_annotations() -> Iterator[None]:
    """Run polarnet as a user's program does: annotations are not checked, so that its own checks are on their own."""
    import jaxtyping

    was = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", was)


@pytest.fixture(scope="module")
def brief_costs() -> Iterator[None]:
    """Measure the cost of a benchmark row once on one window; a full measurement takes longer than the scores."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        for name in ("COUNTED_WINDOWS", "TIMED_WINDOWS", "REPEATS"):
            monkeypatch.setattr(f"polarnet.benchmark.rows.{name}", 1)
        yield


@pytest.fixture
def progress_log(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """Lines on standard error, which is a file, with a line of progress as often as possible."""
    monkeypatch.setattr("polarnet.terminal.progress.LINE_S", 0.0)
    return lambda: capfd.readouterr().err.splitlines()


@pytest.fixture
def forked_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the worker processes of `pmap` fork from one that has imported polarnet, which saves their imports."""
    from types import SimpleNamespace

    from preloaded import FORKSERVER

    monkeypatch.setattr("polarnet.runtime.cluster.multiprocessing", SimpleNamespace(get_context=lambda _: FORKSERVER))


class Simulated(NamedTuple):
    """Four short sequences, and what their events were made with."""

    scenes: Path
    frames: Path
    events: Path
    camera: Any
    seed: int


@pytest.fixture(scope="session")
def simulated(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """Scenes of smooth noise, frames and events of a sensor that differs from sequence to sequence and is noisy."""
    import numpy as np
    import torch

    from polarnet.config.tree import load
    from polarnet.simulation.camera import Camera
    from polarnet.simulation.motion import frame_times_us, random_trajectory
    from polarnet.simulation.scene import scene_from_polarization
    from polarnet.simulation.sets import emulate_scenes
    from polarnet.simulation.truth import frames_of
    from polarnet.storage.frames import Contents, FrameStore, Polarization
    from polarnet.storage.scenes import SceneStore, as_stored

    folder = tmp_path_factory.mktemp("simulated")
    config = load(project_root)
    motion = dataclasses.replace(
        config.synthesize, duration_s=0.2, sensor_height=18, sensor_width=24, acceleration_max_px_s2=4000.0
    )
    ranges = {"contrast_threshold_on": [0.08, 0.31], "cutoff_hz": [30.0, 300.0], "shot_noise_rate_hz": [20.0, 40.0]}
    sensor = dataclasses.replace(config.emulate, randomise=ranges)
    camera = Camera(sensor)
    splits = {"a-0": "train", "b-0": "train", "c-0": "train", "d-0": "val"}
    window, t_us = (motion.sensor_height, motion.sensor_width), frame_times_us(motion)
    scenes = SceneStore.create(
        folder / "scenes.zarr",
        Contents(splits, {"layout": "four_sensors"}, sequences_per_part=2),
        {name: name[0] for name in splits},
        window,
    )
    frames = FrameStore.create(folder / "frames.zarr", Contents(splits), *window)
    for number, name in enumerate(scenes.sequences):
        generator = np.random.default_rng(number)
        coarse = torch.from_numpy(generator.random((1, 3, 12, 16), dtype=np.float32))
        s0, dolp, fraction = torch.nn.functional.interpolate(coarse, (60, 80), mode="bilinear")[0]
        trajectory = random_trajectory(motion, 60, 80, generator)
        stored = as_stored(Polarization(s0, dolp, 3.14 * fraction))
        scenes.write(name, stored, dataclasses.asdict(trajectory), t_us[-1])
        scene = scene_from_polarization(stored.s0, stored.dolp, stored.aolp)
        frames.write(name, torch.tensor(t_us), *frames_of(scene, trajectory, t_us, *window))
    scenes.finish()
    frames.finish()
    emulate_scenes(folder / "scenes.zarr", folder / "events.zarr", camera, 3, map, 1)
    return Simulated(folder / "scenes.zarr", folder / "frames.zarr", folder / "events.zarr", camera, 3)
