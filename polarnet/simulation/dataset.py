"""Emulation of a scene store: into an event store, part by part so that a run can resume."""

import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from torch import Tensor

from polarnet.events.stream import Events
from polarnet.simulation.camera import Camera, channel_size, pixel_analyzers
from polarnet.simulation.motion import Trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization, stretched
from polarnet.storage.events import EventStore
from polarnet.storage.scenes import SceneStore
from polarnet.terminal.progress import steps

Mapper = Callable[..., Iterable[Any]]


def emulate_scenes(
    scenes: str | Path, events: str | Path, camera: Camera, seed: int, mapper: Mapper, threads: int
) -> int:
    """Emulate all sequences of a scene store into an event store, and return their number; both may be at a URL.

    `mapper` is `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`; each of its tasks
    emulates one part on `threads` threads. The event store has the parts of the scene store. After an interruption, a
    run of the same scenes, camera and seed makes the missing parts.
    """
    source = SceneStore.open(scenes)
    size = channel_size(camera.polarizers.layout, source.sensor_height, source.sensor_width)
    store = EventStore.create(
        events, source.sequences, *size, origin_of(source, camera, seed), source.sequences_per_part
    )
    emulated = functools.partial(_emulated, source, camera, seed, threads)
    return fill_store(store, source, emulated, camera, seed, mapper)


def fill_store(
    store: EventStore,
    scenes: SceneStore,
    emulated: Callable[[str], tuple[list[Events], Tensor | None]],
    camera: Camera,
    seed: int,
    mapper: Mapper,
) -> int:
    """Write the events and analyzers of each sequence that is missing in a store; returns the number of sequences."""
    task = functools.partial(_fill_part, scenes=scenes, events=store, emulated=emulated, camera=camera, seed=seed)
    for _ in mapper(task, store.missing_parts()):
        pass
    store.finish()
    return len(store.sequences)


def _fill_part(
    part: str,
    scenes: SceneStore,
    events: EventStore,
    emulated: Callable[[str], tuple[list[Events], Tensor | None]],
    camera: Camera,
    seed: int,
) -> None:
    for sequence in steps(events.parts[part]):
        channels, analyzer = emulated(sequence)
        events.write(sequence, channels, scenes.duration_us(sequence), camera.draws(seed, sequence), analyzer)


def origin_of(scenes: SceneStore, camera: Camera, seed: int) -> dict[str, Any]:
    """All settings and data that determine the events of a scene store; its checksum stands for its pixels."""
    return {**camera.sections, "seed": seed, "scenes": scenes.attributes, "scenes_sha256": scenes.header["checksum"]}


def _emulated(
    scenes: SceneStore, camera: Camera, seed: int, threads: int, sequence: str
) -> tuple[list[Events], Tensor | None]:
    analyzer = pixel_analyzers(camera.drawn(seed, sequence), scenes.sensor_height, scenes.sensor_width)
    return emulate_sequence(scenes, sequence, camera, seed, threads), analyzer


def emulate_sequence(scenes: SceneStore, sequence: str, camera: Camera, seed: int, threads: int) -> list[Events]:
    """Events of the four channels of one stored sequence.

    Its noise, and with `randomise` its camera, depend only on the seed and the sequence's name.
    """
    scene, trajectory, duration_us = motion_over(scenes, sequence)
    size = scenes.sensor_height, scenes.sensor_width
    return emulate_motion(camera.drawn(seed, sequence), scene, trajectory, duration_us, size, threads)


def motion_over(scenes: SceneStore, sequence: str) -> tuple[PolarizationScene, Trajectory, int]:
    """The scene of a stored sequence, the motion over it, and its duration in microseconds."""
    stored = scenes.read(sequence)
    scene = scene_from_polarization(stored.s0, stored.dolp, stored.aolp)
    scene = stretched(scene, scenes.dynamic_range(sequence))
    return scene, Trajectory.from_vector(scenes.trajectory(sequence)), scenes.duration_us(sequence)
