"""Event sets: every sequence of a scene store, emulated into an event store part by part, so that a run can resume."""

import functools
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from polarnet.events.stream import Events
from polarnet.simulation.camera import Camera, grid, pixel_analyzers
from polarnet.simulation.motion import Trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.rotating import RotatingConfig, emulate_rotating
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization, stretched
from polarnet.stokes import NUM_CHANNELS
from polarnet.storage.events import EventStore
from polarnet.storage.scenes import SceneStore
from polarnet.terminal.progress import steps


def emulate_scenes(
    scenes: str | Path,
    events: str | Path,
    camera: Camera,
    seed: int,
    mapper: Callable[..., Iterable[Any]],
    threads: int,
    rotating: RotatingConfig | None = None,
) -> int:
    """Emulate all sequences of a scene store into an event store, and return their number; both may be at a URL.

    With `rotating`, only the test sequences are emulated, behind the rotating polarizer alone: events are in the
    store's first channel, the other three are empty.

    `mapper` is `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`; each of its tasks
    emulates one part on `threads` threads. The event store has the parts of the scene store. After an interruption, a
    run of the same scenes, camera and seed makes the missing parts. The noise of a sequence, and with `randomise` its
    camera, depend only on the seed and the sequence's name.
    """
    source = SceneStore.open(scenes)
    height, width, _ = grid(camera.polarizers.layout, source.sensor_height, source.sensor_width)
    # all settings and data that determine the events; the checksum stands for the pixels of the scenes
    inputs = {"seed": seed, "scenes": source.attributes, "scenes_sha256": source.header["checksum"]}
    origin = {**camera.sections, **inputs, **({"rotating": asdict(rotating)} if rotating else {})}
    sequences = source.of_split("test") if rotating else source.sequences
    store = EventStore.create(events, sequences, height, width, origin, source.sequences_per_part)
    emulate_part = functools.partial(_emulate_part, source, store, camera, seed, threads, rotating)
    for _ in mapper(emulate_part, store.missing_parts()):
        pass
    store.finish()
    return len(sequences)


def _emulate_part(
    scenes: SceneStore,
    store: EventStore,
    camera: Camera,
    seed: int,
    threads: int,
    rotating: RotatingConfig | None,
    part: str,
) -> None:
    size = scenes.sensor_height, scenes.sensor_width
    for sequence in steps(store.parts[part]):
        drawn, analyzer = camera.drawn(seed, sequence, "rotating" if rotating else "emulate"), None
        scene, trajectory, duration_us = motion_over(scenes, sequence)
        if rotating:
            pixels = grid(camera.polarizers.layout, *size)
            first = emulate_rotating(rotating, drawn, scene, trajectory, duration_us, pixels)
            channels = [first, *[Events.empty(pixels.height, pixels.width)] * (NUM_CHANNELS - 1)]
        else:
            channels = emulate_motion(drawn, scene, trajectory, duration_us, size, threads)
            analyzer = pixel_analyzers(drawn, *size)
        store.write(sequence, channels, duration_us, camera.draws(seed, sequence), analyzer)


def motion_over(scenes: SceneStore, sequence: str) -> tuple[PolarizationScene, Trajectory, int]:
    """The scene of a stored sequence, the motion over it, and its duration in microseconds."""
    stored, record = scenes.read(sequence), scenes.record(sequence)
    scene = scene_from_polarization(stored.s0, stored.dolp, stored.aolp)
    scene = stretched(scene, record.get("dynamic_range"))
    return scene, Trajectory.from_record(record["trajectory"]), record["duration_us"]
