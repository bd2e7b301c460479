"""Events of one sensor behind a polarizer that rotates in front of it, on a still or moving scene.

The light behind a polarizer at angle theta is, with e = 1 / extinction ratio (Malus' law of an imperfect polarizer):

    I = ((1 + e) S0 + (1 - e) (S1 cos 2 theta + S2 sin 2 theta)) / 2
"""

import functools
import json
import math
import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from pydantic import Field
from torch import Tensor

from polarnet.events.rotation import Rotation, steady_rotation
from polarnet.events.stream import Events, concatenate
from polarnet.runtime.machine import seed_for
from polarnet.runtime.sections import section
from polarnet.simulation.camera import Camera
from polarnet.simulation.dataset import origin_of
from polarnet.simulation.emulator import EmulatorConfig, SensorState, emulate
from polarnet.simulation.motion import Trajectory, render
from polarnet.simulation.pixels.light import FULL_SCALE
from polarnet.simulation.polarizers import grid
from polarnet.simulation.readout import read_out
from polarnet.simulation.rendering import check_inside
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization
from polarnet.stokes import NUM_CHANNELS
from polarnet.storage.events import EventStore
from polarnet.storage.scenes import SceneStore

CHUNK = 64  # frames rendered at once


@section
class RotatingConfig:
    """Section `rotating` of params.yaml: a polarizer that rotates in front of one sensor."""

    rate_hz: float
    """Turns per second; with a negative rate, the polarizer turns from 0 towards 135 degrees."""
    start_angle_deg: Annotated[float, Field(ge=-360, le=360)]
    extinction_ratio: Annotated[float, Field(ge=1)] | None
    """Transmission along the axis over that across it; null: infinite."""
    frames_per_turn: Annotated[int, Field(ge=32)]
    """Minimum number of rendered frames per turn; `emulate.render_rate_hz` can raise it."""

    def __post_init__(self):
        if self.rate_hz == 0:
            raise ValueError(f"rate_hz: expected turns per second other than 0, got {self.rate_hz}")

    @property
    def rotation(self) -> Rotation:
        """The polarizer's angle over time."""
        return steady_rotation(self.rate_hz, math.radians(self.start_angle_deg))


class RotatingSimulation(NamedTuple):
    """Events of the one sensor, and the polarizer's angle over time."""

    events: Events
    rotation: Rotation
    state: SensorState
    """The sensor after the last frame; hand it back to continue."""


def behind_rotating_polarizer(
    stokes: Float32[Tensor, "n 3 h w"], angles: Float64[np.ndarray, " n"], extinction_ratio: float | None
) -> Float32[Tensor, "n h w"]:
    """Intensity behind a polarizer at angle `angles[k]` (radians) in frame k; a ratio of None means infinite."""
    leakage = 0.0 if extinction_ratio is None else 1 / extinction_ratio
    cos, sin = (torch.from_numpy(f(2 * angles)).float()[:, None, None] for f in (np.cos, np.sin))
    s0, s1, s2 = stokes.unbind(1)
    return (((1 + leakage) * s0 + (1 - leakage) * (s1 * cos + s2 * sin)) / 2).clamp(min=0)


def rotating_times_us(
    config: RotatingConfig, emulator: EmulatorConfig, start_us: int, stop_us: int
) -> Int64[np.ndarray, " n"]:
    """Times of rendered light from `start_us` to `stop_us`, both included."""
    rate_hz = max(abs(config.rate_hz) * config.frames_per_turn, emulator.render_rate_hz or 0)
    steps = max(1, math.ceil((stop_us - start_us) * 1e-6 * rate_hz))
    return np.unique(np.rint(np.linspace(start_us, stop_us, steps + 1)).astype(np.int64))


def emulate_rotating(
    scene: PolarizationScene,
    trajectory: Trajectory | None,
    t_us: Int64[np.ndarray, " n"],
    height: int,
    width: int,
    rotating: RotatingConfig,
    emulator: EmulatorConfig,
    key: int,
    state: SensorState | None = None,
    pitch: int = 1,
) -> RotatingSimulation:
    """Events of a sensor of height x width pixels under light rendered at times `t_us` (`rotating_times_us`).

    Without a trajectory the sensor rests on the scene's upper left corner. `key` (64 bits) seeds mismatch and noise.
    The pixels of a moving sensor lie `pitch` pixels of the scene apart (`polarizers.grid`).
    A span cut into pieces, each given the state that the previous piece returned and times after it, gives the events
    of the whole span. ValueError if the sensor leaves the scene.
    """
    if trajectory is not None:
        check_inside(scene, trajectory.pose(t_us * 1e-6), t_us, pitch * height, pitch * width)
    elif height > scene.height or width > scene.width:
        raise ValueError(f"a sensor of {height}x{width} px exceeds the scene of {scene.height}x{scene.width}")
    rotation, pieces = rotating.rotation, []
    for first in range(0, len(t_us), CHUNK):
        times = t_us[first : first + CHUNK]
        if trajectory is None:
            stokes = scene.stokes[None, :, :height, :width].expand(len(times), -1, -1, -1)
        else:
            stokes = render(scene, trajectory, times * 1e-6, height, width, pitch)
        light = behind_rotating_polarizer(stokes, rotation.at(times), rotating.extinction_ratio)
        frames = (FULL_SCALE * light).clamp(max=FULL_SCALE)[:, None]
        (events,), state = emulate(frames, times, emulator, key, state)
        pieces.append(events)
    if state is None:
        raise ValueError("expected at least one time to render the light at, got none")
    return RotatingSimulation(concatenate(pieces), rotation, state)


def emulate_rotating_scenes(
    scenes: Path,
    events: Path,
    rotating: RotatingConfig,
    camera: Camera,
    seed: int,
    mapper: Callable[..., Iterable[Any]],
) -> int:
    """Emulate the test sequences of a scene store behind the rotating polarizer, and return their number.

    Sensor, readout and motion are those of the four channels, but the noise differs. Events are in the store's first
    channel; the other three are empty. A store of the same scenes and settings is kept, any other is replaced.
    `mapper` is as in `dataset.emulate_scenes`.
    """
    source = SceneStore.open(scenes)
    attributes = {**origin_of(source, camera, seed), "rotating": asdict(rotating)}
    height, width, _ = grid(source.attributes["layout"], source.sensor_height, source.sensor_width)
    names = source.of_split("test")
    if events.exists():
        if EventStore.open(events).attributes == json.loads(json.dumps(attributes)):
            return len(names)
        shutil.rmtree(events)
    store = EventStore.create(events, names, height, width, attributes, source.sequences_per_part)
    task = functools.partial(_emulate_part, scenes=source, events=store, rotating=rotating, camera=camera, seed=seed)
    for _ in mapper(task, store.missing_parts()):
        pass
    store.finish()
    return len(names)


def _emulate_part(
    part: str, scenes: SceneStore, events: EventStore, rotating: RotatingConfig, camera: Camera, seed: int
) -> None:
    height, width, pitch = grid(scenes.attributes["layout"], scenes.sensor_height, scenes.sensor_width)
    for sequence in events.parts[part]:
        record, key = scenes.read(sequence), seed_for(seed, sequence, "rotating")
        drawn = camera.drawn(seed, sequence)
        scene = scene_from_polarization(record.s0, record.dolp, record.aolp)
        trajectory = Trajectory.from_vector(record.trajectory.numpy())
        t_us = rotating_times_us(rotating, drawn.sensor, 0, record.duration_us)
        emulation = emulate_rotating(scene, trajectory, t_us, height, width, rotating, drawn.sensor, key, pitch=pitch)
        output, _ = read_out(emulation.events, drawn.readout, key, record.duration_us)
        channels = [output, *[Events.empty(height, width)] * (NUM_CHANNELS - 1)]
        events.write(sequence, channels, record.duration_us, camera.draws(seed, sequence))
