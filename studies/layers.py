"""Sequences that do not move as one plane, which `studies.robustness --layers` scores."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.benchmark.sequences import TestSequence
from polarnet.config.tree import Config
from polarnet.events.stream import concatenate
from polarnet.simulation.emulator import emulate
from polarnet.simulation.motion import Sine, Trajectory, frame_times_us, resting_trajectory
from polarnet.simulation.pixels.light import FULL_SCALE
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization
from polarnet.simulation.sets import motion_over
from polarnet.simulation.truth import frames_of
from polarnet.stokes import aolp, dolp, stokes_from_intensities
from polarnet.storage.scenes import SceneStore

KINDS = ("two", "turning")
"""An ellipse of one photograph that moves before another, which moves too; or turns before another, which rests."""
EXTENT = 0.3  # half axes of the ellipse, as fractions of the sensor's sides
TURN_RAD, TURNS_RAD_S = 0.8, 3.0  # amplitude and rate of the sine: 2.4 rad/s at most, 130 pixels/s at the edge
RENDER_US = 2000  # time between rendered frames
CHUNK = 32  # frames rendered at once


class Layers(NamedTuple):
    """A scene before another, and where the first covers the second."""

    back: tuple[PolarizationScene, Trajectory]
    front: tuple[PolarizationScene, Trajectory]
    cover: PolarizationScene
    """S0 is the opacity of `front`, which moves with it."""
    height: int
    width: int

    def at(self, t_us: Sequence[int]) -> Float[Tensor, "n 4 h w"]:
        """Intensities behind the four polarizers at times in microseconds."""
        size = self.height, self.width
        back, front, cover = (
            frames_of(scene, path, t_us, *size)[0]
            for scene, path in (self.back, self.front, (self.cover, self.front[1]))
        )
        opacity = (cover[:, 0] + cover[:, 2])[:, None]
        return torch.lerp(back, front, opacity)


def layers_of(scenes: SceneStore, name: str, kind: str) -> Layers:
    """The picture of a stored sequence behind that of the next sequence."""
    names = list(scenes.sequences)
    (back, path, _), (front, other, _) = (
        motion_over(scenes, names[(names.index(name) + k) % len(names)]) for k in range(2)
    )
    if kind == "turning":
        rest, turn = resting_trajectory(1, 1), Sine(TURN_RAD, TURNS_RAD_S, 0.0)
        path, other = replace(rest, x=path.x, y=path.y), replace(rest, x=other.x, y=other.y, roll=turn)
    height, width = front.stokes.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    axes = EXTENT * scenes.sensor_height, EXTENT * scenes.sensor_width
    inside = ((y - other.y) / axes[0]) ** 2 + ((x - other.x) / axes[1]) ** 2 <= 1
    nothing = torch.zeros(height, width)
    cover = scene_from_polarization(inside.float(), nothing, nothing)
    return Layers((back, path), (front, other), cover, scenes.sensor_height, scenes.sensor_width)


def layered(scenes: SceneStore, name: str, config: Config, kind: str) -> TestSequence:
    """Two layers with the events of the configured camera, and their truth."""
    layers, camera = layers_of(scenes, name, kind), config.camera.drawn(config.seed, name)
    t_us = torch.tensor(frame_times_us(config.synthesize))
    times, state = np.arange(0, int(t_us[-1]) + RENDER_US, RENDER_US), None
    parts = []
    for first in range(0, len(times), CHUNK):
        now = times[first : first + CHUNK]
        events, state = emulate(FULL_SCALE * layers.at(now.tolist()), now, camera.sensor, camera.key, state)
        parts.append(events)
    channels = [concatenate(of_channel) for of_channel in zip(*parts, strict=True)]
    intensity = layers.at(t_us[1:].tolist())
    vectors = stokes_from_intensities(intensity)
    s0 = intensity[:, 0] + intensity[:, 2]
    return TestSequence(name, scenes.scene_of[name], channels, t_us, dolp(vectors).clamp(0, 1), aolp(vectors), s0, None)
