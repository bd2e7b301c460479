"""The emulate stage killed with SIGKILL, by itself and on a Dask cluster: the rerun redoes only what is missing.

Stages start in children of a process that has imported the stage once, so that ten deaths take seconds.
"""

import contextlib
import functools
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from part_fixtures import files_of
from preloaded import FORKSERVER
from skimage import data

SEQUENCES = 20
SEQUENCES_PER_PART = 2
PARTS = 10
KILLS = 10
PATIENCE_S = 120.0
SEED = 20


@pytest.fixture(scope="module")
def folder(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder whose scenes are twenty motions of a window over the coffee photograph."""
    from polarnet.config.tree import load
    from polarnet.simulation.motion import SynthesizeConfig, Trajectory, random_trajectory
    from polarnet.simulation.scene import polarization_from_rgb
    from polarnet.storage.frames import Contents, Polarization
    from polarnet.storage.scenes import SceneStore

    motion: SynthesizeConfig = load(
        project_root, ["synthesize.sensor_height=60", "synthesize.sensor_width=90", "synthesize.duration_s=0.5"]
    ).synthesize
    picture = torch.from_numpy(data.coffee()[100:300, 150:450]).permute(2, 0, 1).float() / 255
    folder = tmp_path_factory.mktemp("interrupted") / "data"
    names = [f"coffee-{i}" for i in range(SEQUENCES)]
    scenes = SceneStore.create(
        folder / "scenes.zarr",
        Contents(dict.fromkeys(names, "train"), sequences_per_part=SEQUENCES_PER_PART),
        dict.fromkeys(names, "coffee"),
        (motion.sensor_height, motion.sensor_width),
        Trajectory.vector_names(),
    )
    for number, name in enumerate(names):
        trajectory = random_trajectory(motion, 200, 300, np.random.default_rng(number))
        vector, scene = torch.from_numpy(trajectory.to_vector()), Polarization(*polarization_from_rgb(picture))
        scenes.write(name, scene, vector, round(1e6 * motion.duration_s))
    scenes.finish()
    return folder


def overrides(folder: Path, events: Path) -> list[str]:
    return [f"paths.data={folder}", f"paths.events={events}", f"hydra.run.dir={events.parent / 'log'}"]


def run_stage(arguments: list[str]) -> None:
    """In a child that was forked from a process which had imported the stage."""
    os.setpgid(0, 0)
    import stages.emulate

    sys.argv = ["stages.emulate", *arguments]
    stages.emulate.main()


def start(arguments: list[str]):
    """A stage in a process group of its own."""
    process = FORKSERVER.Process(target=run_stage, args=([*arguments, "runtime.threads=1"],))
    process.start()
    until(lambda: os.getpgid(process.pid) == process.pid)  # else the signal would find no such group
    return process


def ended(process) -> int:
    """Exit status of a stage once it has ended, negative for a signal."""
    process.join(PATIENCE_S)
    assert process.exitcode is not None, "the stage hangs"
    return process.exitcode


def content(folder: Path) -> dict[str, bytes]:
    return {name: content for name, content in files_of(folder).items() if Path(name).name != "origin.json"}


def finished(unfinished: Path) -> set[str]:
    """Names of the parts that are whole: a part gets its name last."""
    return {path.name for path in unfinished.glob("part-[0-9][0-9][0-9][0-9][0-9]")}


def identities(store: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of every finished part: another one if written again, even with equal bytes."""
    parts = {part: (store / part).stat() for part in finished(store)}
    return {part: (status.st_ino, status.st_mtime_ns) for part, status in parts.items()}


def until(true: Callable[[], bool], still_worth_it: Callable[[], bool] = lambda: True) -> None:
    latest = time.monotonic() + PATIENCE_S
    while not true() and still_worth_it():
        assert time.monotonic() < latest, "nothing happens"
        time.sleep(0.001)


class Undisturbed(NamedTuple):
    """Output and pace of an uninterrupted run."""

    content: dict[str, bytes]
    seconds_to_first: float
    seconds_each: float


@pytest.fixture(scope="module")
def undisturbed(folder: Path) -> Undisturbed:
    events = folder.parent / "undisturbed" / "events.zarr"
    ended(start(overrides(folder, events.with_name("warm.zarr"))))  # compiles what is not compiled yet
    begin = time.monotonic()
    running = start(overrides(folder, events))
    until(lambda: bool(finished(events.with_name("events.zarr.tmp"))))
    first = time.monotonic()
    assert ended(running) == 0
    return Undisturbed(content(events), first - begin, (time.monotonic() - first) / (PARTS - 1))


@pytest.mark.thorough
def test_ten_deaths_at_random_moments_change_no_byte_and_no_finished_part(folder, undisturbed, tmp_path):
    """Half of the deaths come before a run has finished anything, half up to 1.5 parts after its first."""
    events, unfinished = tmp_path / "events.zarr", tmp_path / "events.zarr.tmp"
    generator = np.random.default_rng(SEED)
    known: dict[str, tuple[int, int]] = {}
    deaths = []
    while len(deaths) < KILLS:
        done = len(finished(unfinished))
        running = start(overrides(folder, events))
        if len(deaths) % 2:
            until(lambda done=done: len(finished(unfinished)) > done, lambda: not events.exists())
            time.sleep(generator.uniform(0, 1.5 * undisturbed.seconds_each))
        else:
            time.sleep(generator.uniform(0, undisturbed.seconds_to_first))
        with contextlib.suppress(ProcessLookupError):  # where it has ended already
            os.killpg(running.pid, signal.SIGKILL)
        status = ended(running)
        if events.exists():  # it was quicker than its death: begin anew
            assert identities(events).items() >= known.items()
            shutil.rmtree(events)
            known = {}
            continue
        assert status == -signal.SIGKILL
        assert identities(unfinished).items() >= known.items()
        known = identities(unfinished)
        deaths.append(len(finished(unfinished)))
    assert max(deaths) > 0
    assert ended(start(overrides(folder, events))) == 0
    assert identities(events).items() >= known.items()
    assert content(events) == undisturbed.content
    assert not unfinished.exists()


@pytest.fixture(scope="module")
def cluster() -> Iterator:
    """A Dask cluster of one worker, to begin with; workers fork as the stages above do."""
    dask = pytest.importorskip("dask")
    distributed = pytest.importorskip("distributed")
    forking = dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"})
    with forking, distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster


def over_dask(folder: Path, events: Path, cluster) -> None:
    """The emulate stage, in this process, on the workers of a cluster."""
    from polarnet.config.tree import load
    from polarnet.runtime.cluster import pmap
    from polarnet.simulation.dataset import emulate_scenes

    config = load(Path(__file__).resolve().parents[2])
    mapper = functools.partial(pmap, workers=1, label="emulate", address=cluster.scheduler_address)
    assert emulate_scenes(folder / "scenes.zarr", events, config.camera, config.seed, mapper, 1) == SEQUENCES


@pytest.mark.thorough
def test_one_and_three_dask_workers_and_one_killed_half_way_give_the_bytes_of_one_process(
    folder, undisturbed, cluster, tmp_path
):
    over_dask(folder, tmp_path / "one.zarr", cluster)
    assert content(tmp_path / "one.zarr") == undisturbed.content

    cluster.scale(3)
    cluster.wait_for_workers(3)
    over_dask(folder, tmp_path / "three.zarr", cluster)
    assert content(tmp_path / "three.zarr") == undisturbed.content

    events, unfinished = tmp_path / "killed.zarr", tmp_path / "killed.zarr.tmp"
    done_at_death: list[int] = []

    def kill_one_worker() -> None:
        until(lambda: len(finished(unfinished)) >= 2)
        busiest = max(cluster.scheduler.workers.values(), key=lambda worker: len(worker.processing))
        os.kill(pids[busiest.address], signal.SIGKILL)
        done_at_death.append(len(finished(unfinished)))

    with cluster.get_client() as client:
        pids = client.run(os.getpid)
    killer = threading.Thread(target=kill_one_worker)
    killer.start()
    over_dask(folder, events, cluster)
    killer.join()
    assert 2 <= done_at_death[0] < PARTS
    assert content(events) == undisturbed.content
