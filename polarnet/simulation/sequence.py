"""Simulation in memory: from one picture to the events of four channels and their ground truth."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64
from torch import Tensor, tensor

from polarnet.events.stream import Events
from polarnet.runtime.arrays import Array
from polarnet.runtime.machine import generator_for
from polarnet.simulation.camera import Camera, grid, pixel_analyzers
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import SynthesizeConfig, Trajectory, frame_times_us, random_trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.scene import PolarizationScene, check_scene, scene_from_rgb, stretched
from polarnet.simulation.truth import frames_of


class Simulation(NamedTuple):
    """Events of a moving sensor behind four polarizers, and the truth at frame times.

    >>> from dataclasses import replace
    >>> import torch
    >>> from polarnet.simulation import MOTIONS, SENSORS, simulate
    >>> motion = replace(MOTIONS["default"], duration_s=0.1, sensor_height=16, sensor_width=24)
    >>> simulate(torch.rand(3, 120, 180), motion, SENSORS["default"], seed=1).t_us
    tensor([     0,  33333,  66667, 100000])
    """

    events: list[Events]
    """Behind the polarizers at 0, 45, 90 and 135 degrees, in microseconds from the start of the motion."""
    t_us: Int64[Tensor, " n"]
    """Times of the true frames, microseconds."""
    intensities: Float[Tensor, "n 4 h w"]
    """Behind the four polarizers, in [0, 1]."""
    dolp: Float[Tensor, "n h w"]
    aolp: Float[Tensor, "n h w"]
    """Radians in [0, pi)."""
    trajectory: Trajectory
    camera: Camera
    """The camera, with the values that it drew where its parameters have ranges (`randomise`)."""
    analyzer: Float32[Tensor, "4 3 *pixels"]
    """Weights of S0, S1 and S2 in the light behind the four polarizers, of each pixel if pixels differ
    (`pixel_analyzers`)."""


def simulate(
    picture: Float[Array, "3 h w"] | PolarizationScene,
    motion: SynthesizeConfig,
    sensor: EmulatorConfig | Camera,
    seed: int,
) -> Simulation:
    """Simulate an event camera whose sensor moves over a picture or a scene.

    A picture is RGB, numpy or torch, of shape (3, height, width), in floating-point numbers of any precision in [0, 1].
    Hue becomes AoLP, saturation DoLP and value S0, as in the pipeline. The same arguments give the same numbers.
    A sensor alone is behind ideal polarizers; a `Camera` has its own polarizers and readout.

    TypeError for arguments of another kind; ValueError for integers, values outside [0, 1], another order of axes, NaN
    and infinity, unphysical scenes, and pictures too small for the sensor and its motion. The message gives the remedy.

    >>> from dataclasses import replace
    >>> import torch
    >>> from polarnet.simulation import MOTIONS, SENSORS, simulate
    >>> motion = replace(MOTIONS["default"], duration_s=0.1, sensor_height=16, sensor_width=24)
    >>> simulate(torch.rand(3, 120, 180), motion, SENSORS["default"], seed=1).dolp.shape
    torch.Size([4, 16, 24])
    """
    for name, value, kinds, example in (
        ("motion", motion, (SynthesizeConfig,), 'MOTIONS["default"]'),
        ("sensor", sensor, (EmulatorConfig, Camera), 'SENSORS["default"]'),
    ):
        if not isinstance(value, kinds):
            expected = " or ".join(kind.__name__ for kind in kinds)
            raise TypeError(f"{name}: expected {expected} such as {example}, got {value!r}")
    if not isinstance(seed, (int, np.integer)):
        raise TypeError(f"seed: expected a whole number, got {seed!r}")
    scene = picture if isinstance(picture, PolarizationScene) else scene_from_rgb(picture)
    check_scene(scene)
    scene = stretched(scene, motion.dynamic_range)
    trajectory = random_trajectory(motion, scene.height, scene.width, generator_for(seed, "picture", "motion"))
    camera = (sensor if isinstance(sensor, Camera) else Camera(sensor)).drawn(seed, "picture")
    t_us, size = frame_times_us(motion), (motion.sensor_height, motion.sensor_width)
    events = emulate_motion(camera, scene, trajectory, t_us[-1], size)
    pixels = grid(camera.polarizers.layout, *size)
    frames = frames_of(scene, trajectory, t_us, *pixels)
    return Simulation(events, tensor(t_us), *frames, trajectory, camera, pixel_analyzers(camera, *size))
