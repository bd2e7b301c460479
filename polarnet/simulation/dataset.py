"""Emulation of a scene store into an event store, part by part, so that a run can stop and resume."""

import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from polarnet import __version__
from polarnet.events.stream import Events
from polarnet.simulation.camera import Camera
from polarnet.simulation.motion import Trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.polarizers import channel_size
from polarnet.simulation.scene import scene_from_polarization
from polarnet.storage.events import EventStore
from polarnet.storage.scenes import SceneStore


def emulate_scenes(
    scenes: str | Path,
    events: str | Path,
    camera: Camera,
    seed: int,
    mapper: Callable[..., Iterable[Any]],
    threads: int,
) -> int:
    """Emulate all sequences of a scene store into an event store, and return their number; both may be at a URL.

    `mapper` is `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`; each of its tasks
    emulates one part on `threads` threads. The event store has the parts of the scene store. After an interruption, a
    run of the same scenes, camera and seed makes the missing parts.
    """
    source = SceneStore.open(scenes)
    attributes = origin_of(source, camera, seed)
    size = channel_size(camera.polarizers.layout, source.sensor_height, source.sensor_width)
    store = EventStore.create(events, source.sequences, *size, attributes, source.sequences_per_part)
    task = functools.partial(_emulate_part, scenes=source, events=store, camera=camera, seed=seed, threads=threads)
    for _ in mapper(task, store.missing_parts()):
        pass
    store.finish()
    return len(store.sequences)


def origin_of(scenes: SceneStore, camera: Camera, seed: int) -> dict[str, Any]:
    """All settings and data that determine the events of a scene store."""
    return {
        **camera.sections,
        "seed": seed,
        "scenes": scenes.attributes,
        "polarnet": __version__,  # an unfinished store of another version is not resumed
    }


def emulate_sequence(scenes: SceneStore, sequence: str, camera: Camera, seed: int, threads: int) -> list[Events]:
    """Events of the four channels of one stored sequence.

    Its noise, and with `randomise` its camera, depend only on the seed and the sequence's name.
    """
    record, size = scenes.read(sequence), (scenes.sensor_height, scenes.sensor_width)
    scene = scene_from_polarization(record.s0, record.dolp, record.aolp)
    trajectory = Trajectory.from_vector(record.trajectory.numpy())
    return emulate_motion(camera.drawn(seed, sequence), scene, trajectory, record.duration_us, size, threads)


def _emulate_part(part: str, scenes: SceneStore, events: EventStore, camera: Camera, seed: int, threads: int) -> None:
    for sequence in events.parts[part]:
        channels = emulate_sequence(scenes, sequence, camera, seed, threads)
        events.write(sequence, channels, scenes.duration_us(sequence), camera.draws(seed, sequence))
