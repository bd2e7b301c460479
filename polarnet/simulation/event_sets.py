"""Event sets: every sequence of a scene store, emulated into an event store part by part, so that a run can resume."""

import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from torch import Tensor

from polarnet.events.stream import Events
from polarnet.simulation.camera import Camera, grid, pixel_analyzers
from polarnet.simulation.motion import Trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization, stretched
from polarnet.storage.events import EventStore
from polarnet.storage.scenes import SceneStore
from polarnet.terminal.progress import steps

Mapper = Callable[..., Iterable[Any]]
Emulated = tuple[list[Events], int, dict[str, Any], Tensor | None]
"""Channels of a sequence, its duration in microseconds, the camera's drawn values and the analyzers of its pixels."""


def emulate_scenes(
    scenes: str | Path, events: str | Path, camera: Camera, seed: int, mapper: Mapper, threads: int
) -> int:
    """Emulate all sequences of a scene store into an event store, and return their number; both may be at a URL.

    `mapper` is `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`; each of its tasks
    emulates one part on `threads` threads. The event store has the parts of the scene store. After an interruption, a
    run of the same scenes, camera and seed makes the missing parts. The noise of a sequence, and with `randomise` its
    camera, depend only on the seed and the sequence's name.
    """
    source = SceneStore.open(scenes)
    height, width, _ = grid(camera.polarizers.layout, source.sensor_height, source.sensor_width)
    store = EventStore.create(
        events, source.sequences, height, width, origin_of(source, camera, seed), source.sequences_per_part
    )
    return fill_store(store, functools.partial(_emulated, source, camera, seed, threads), mapper)


def fill_store(store: EventStore, emulated: Callable[[str], Emulated], mapper: Mapper) -> int:
    """Write each sequence that is missing in a store; returns the number of sequences."""
    for _ in mapper(functools.partial(_fill_part, store, emulated), store.missing_parts()):
        pass
    store.finish()
    return len(store.sequences)


def _fill_part(store: EventStore, emulated: Callable[[str], Emulated], part: str) -> None:
    for sequence in steps(store.parts[part]):
        store.write(sequence, *emulated(sequence))


def origin_of(scenes: SceneStore, camera: Camera, seed: int) -> dict[str, Any]:
    """All settings and data that determine the events of a scene store; its checksum stands for its pixels."""
    return {**camera.sections, "seed": seed, "scenes": scenes.attributes, "scenes_sha256": scenes.header["checksum"]}


def _emulated(scenes: SceneStore, camera: Camera, seed: int, threads: int, sequence: str) -> Emulated:
    drawn, size = camera.drawn(seed, sequence), (scenes.sensor_height, scenes.sensor_width)
    scene, trajectory, duration_us = motion_over(scenes, sequence)
    channels = emulate_motion(drawn, scene, trajectory, duration_us, size, threads)
    return channels, duration_us, camera.draws(seed, sequence), pixel_analyzers(drawn, *size)


def motion_over(scenes: SceneStore, sequence: str) -> tuple[PolarizationScene, Trajectory, int]:
    """The scene of a stored sequence, the motion over it, and its duration in microseconds."""
    stored, record = scenes.read(sequence), scenes.record(sequence)
    scene = scene_from_polarization(stored.s0, stored.dolp, stored.aolp)
    scene = stretched(scene, record.get("dynamic_range"))
    return scene, Trajectory.from_record(record["trajectory"]), record["duration_us"]
