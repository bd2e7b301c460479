"""Events of one sensor behind a polarizer that rotates in front of it: one channel with weights in time."""

import math
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Int64
from pydantic import Field

from polarnet.events.rotation import Rotation, steady_rotation
from polarnet.events.stream import Events
from polarnet.runtime.sections import section
from polarnet.simulation.camera import Camera, Grid, read_out
from polarnet.simulation.emulator import Channels, emulate_frames
from polarnet.simulation.motion import Trajectory
from polarnet.simulation.moving_sensor import behind_polarizers, checked_pose, render_times_us, rendered_chunks
from polarnet.simulation.scene import PolarizationScene
from polarnet.stokes import analyzer


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

    def weights(self, t_us: Int64[np.ndarray, " n"]) -> Float32[np.ndarray, "1 3 n 1 1"]:
        """Weights of S0, S1 and S2 behind the polarizer in each frame."""
        weights = analyzer(self.rotation.at(t_us), self.extinction_ratio or math.inf)
        return weights.astype(np.float32)[None, ..., None, None]


def emulate_rotating(
    rotating: RotatingConfig,
    camera: Camera,
    scene: PolarizationScene,
    trajectory: Trajectory,
    duration_us: int,
    pixels: Grid,
) -> Events:
    """Events of one sensor, behind the rotating polarizer alone, that moves over a scene for `duration_us`.

    ValueError if the sensor leaves the scene.
    """
    size, sensor = (pixels.height, pixels.width), camera.sensor
    t_us = render_times_us(trajectory, duration_us, *size, sensor, abs(rotating.rate_hz) * rotating.frames_per_turn)
    pose = checked_pose(scene, trajectory, t_us, size, pixels.pitch)
    rendered = rendered_chunks(scene, pose, t_us, size)
    frames = ((times, behind_polarizers(stokes, rotating.weights(times))) for times, stokes in rendered)
    (events,), _ = emulate_frames(Channels(*size, sensor, camera.key), frames)
    return read_out(events, camera.readout, duration_us)
