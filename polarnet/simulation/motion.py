"""Motion of a sensor over a scene: closed-form trajectories of bounded speed and acceleration, and rendering."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64
from pydantic import Field, TypeAdapter
from torch import Tensor

from polarnet.runtime.compilation import compiled, inlined
from polarnet.runtime.sections import section
from polarnet.simulation.scene import PolarizationScene

HARMONICS = 3  # number of sines in the motion along each axis
HARMONIC_SPEEDS = np.array([1.0, 0.5, 0.25])  # typical share of each sine in the speed: mostly drift, some turning
PHASES = np.linspace(0, 2 * math.pi, 4096, endpoint=False)
GRID_SLACK = 1e-4  # relative; a maximum over PHASES is at most (HARMONICS * pi / 4096)^2 = 5e-6 below the true one
BORDER_SLACK_PX = 0.02  # GRID_SLACK for positions, enough for scenes of up to 4000 pixels a side
TURN_SHARE = 0.2  # share of the allowed speed and acceleration for roll, and the same share again for zoom
TURN_RATE_MAX = 2 * math.pi  # radians per second, maximum rate of the sines of roll and zoom
FASTEST_OVER_SLOWEST = 3.0  # factor by which the sensor may turn back faster than the scene's border requires
ATTEMPTS = 64
MAX_SPEED_PX_S = 1e6


@section
class SynthesizeConfig:
    """Section `synthesize` of params.yaml. Speeds are in scene pixels and hold for every sensor pixel.

    >>> from dataclasses import replace
    >>> from polarnet.simulation import MOTIONS
    >>> replace(MOTIONS["default"], duration_s=2.0).duration_s
    2.0
    """

    sequences_per_picture: Annotated[int, Field(gt=0, le=10_000)]
    duration_s: Annotated[float, Field(gt=0, le=3600)]
    frame_rate_hz: Annotated[float, Field(gt=0, le=100_000)]
    """Rate of the ground-truth frames; the windows of events between frames are the network's inputs."""
    sensor_height: Annotated[int, Field(ge=2, le=4096)]
    sensor_width: Annotated[int, Field(ge=2, le=4096)]
    speed_min_px_s: Annotated[float, Field(gt=0, le=MAX_SPEED_PX_S)]
    """The peak speed of a sequence is drawn between this and speed_max_px_s."""
    speed_max_px_s: Annotated[float, Field(gt=0, le=MAX_SPEED_PX_S)]
    acceleration_max_px_s2: Annotated[float, Field(gt=0, le=1e9)]
    rotation_max_deg: Annotated[float, Field(ge=0, le=90)]
    zoom_max: Annotated[float, Field(ge=1, le=16)]
    dynamic_range: Annotated[float, Field(gt=1, le=1e8)] | None
    """Brightest over darkest light of a scene, to which `scene.stretched` stretches its S0; null: S0 as it is."""

    def __post_init__(self):
        if self.speed_max_px_s < self.speed_min_px_s:
            raise ValueError(f"speed_max_px_s: expected >= speed_min_px_s {self.speed_min_px_s}, got {self}")
        if round(self.duration_s * self.frame_rate_hz) < 1:
            raise ValueError(f"duration_s: expected at least one frame at {self.frame_rate_hz} Hz, got {self}")


class Pose(NamedTuple):
    """Place and orientation of the sensor, at one or many times."""

    x: Float64[np.ndarray, "*n"]  # scene column under the sensor's centre
    y: Float64[np.ndarray, "*n"]  # scene row
    angle: Float64[np.ndarray, "*n"]  # radians by which the camera is rolled clockwise; the picture turns the other way
    zoom: Float64[np.ndarray, "*n"]  # sensor pixels per scene pixel, >= 1 in a `Trajectory`


@dataclass(frozen=True)
class Sine:
    """amplitude * sin(rate * t + phase), rate in radians per second."""

    amplitude: float
    rate: float
    phase: float

    def at(self, t_s: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Value at times in seconds."""
        return self.amplitude * np.sin(self.rate * t_s + self.phase)


@dataclass(frozen=True)
class Trajectory:
    """A motion in closed form; the sensor never leaves the scene for which the trajectory was drawn.

    >>> import numpy as np
    >>> from polarnet.simulation import MOTIONS, random_trajectory
    >>> trajectory = random_trajectory(MOTIONS["default"], 240, 320, np.random.default_rng(1))
    >>> trajectory.pose(np.array([0.0, 0.5])).zoom
    array([1., 1.])
    """

    x: float  # mean column of the sensor's centre
    y: float  # mean row
    x_sines: tuple[Sine, ...]  # HARMONICS sines
    y_sines: tuple[Sine, ...]
    roll: Sine  # radians
    zoom: Sine  # added to 1 + its amplitude, so that the zoom is at least 1
    speed_px_s: float  # upper bound over all sensor pixels and times, reached without roll and zoom

    def pose(self, t_s: Float64[np.ndarray, "*n"]) -> Pose:
        """Pose at times in seconds from the start of the sequence."""
        return Pose(
            x=self.x + sum((sine.at(t_s) for sine in self.x_sines), np.zeros_like(t_s)),
            y=self.y + sum((sine.at(t_s) for sine in self.y_sines), np.zeros_like(t_s)),
            angle=self.roll.at(t_s),
            zoom=1 + self.zoom.amplitude + self.zoom.at(t_s),
        )

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "Trajectory":
        """The trajectory of which `dataclasses.asdict` makes this record, exactly; ValueError for another record."""
        return TypeAdapter(cls).validate_python(record)


def resting_trajectory(height: int, width: int) -> Trajectory:
    """A sensor of this size that rests on the scene's upper left corner."""
    still = Sine(0.0, 0.0, 0.0)
    axis = (still,) * HARMONICS
    return Trajectory((width - 1) / 2, (height - 1) / 2, axis, axis, roll=still, zoom=still, speed_px_s=0.0)


def random_trajectory(
    config: SynthesizeConfig, scene_height: int, scene_width: int, generator: np.random.Generator
) -> Trajectory:
    """A smooth motion of a sensor inside a scene.

    The velocity along each axis is a sum of harmonics, the slowest of which turns the sensor back before the border.
    The peak speed is drawn between the configured bounds, lowered where the scene or the acceleration limit demands it,
    and reached at a random time. ValueError if the scene is too small for the sensor or for its slowest motion.

    >>> import numpy as np
    >>> from polarnet.simulation import MOTIONS, random_trajectory
    >>> random_trajectory(MOTIONS["default"], 240, 320, np.random.default_rng(1)).speed_px_s <= 160
    True
    """
    reach_x, reach_y = _reach(config)
    room = np.array([scene_width - 1 - 2 * reach_x, scene_height - 1 - 2 * reach_y]) - 2 * BORDER_SLACK_PX
    if room.min() <= 0:
        raise ValueError(
            f"a scene of {scene_height}x{scene_width} (height x width) is too small: a sensor of "
            f"{config.sensor_height}x{config.sensor_width} rolled by up to {config.rotation_max_deg:g} degrees needs "
            f"more than {2 * reach_y + 1:.0f}x{2 * reach_x + 1:.0f}; use larger pictures or a smaller sensor"
        )
    speed = generator.uniform(config.speed_min_px_s, config.speed_max_px_s)
    drift = _drift_share(config)
    for _ in range(ATTEMPTS):
        shape = _random_shape(generator)
        crowding = max(shape.extent / room)  # per pixel
        # rate >= drift * speed * crowding to turn back in time, <= acceleration / (speed * peak) to turn softly
        highest = math.sqrt(config.acceleration_max_px_s2 / (drift * shape.acceleration * crowding))
        if highest >= config.speed_min_px_s:
            break
    else:
        enough = shape.extent * (drift * shape.acceleration * config.speed_min_px_s**2 / config.acceleration_max_px_s2)
        width, height = np.array([scene_width, scene_height]) + np.maximum(enough - room, 0)
        raise ValueError(
            f"a scene of {scene_height}x{scene_width} leaves a sensor of {config.sensor_height}x{config.sensor_width} "
            f"too little room to reach speed_min_px_s={config.speed_min_px_s:g} within "
            f"acceleration_max_px_s2={config.acceleration_max_px_s2:g} (about {highest:.0f} px/s can be reached); "
            f"use pictures of about {math.ceil(height)}x{math.ceil(width)}, a smaller sensor or a lower speed"
        )
    speed = min(speed, highest)
    slowest = drift * speed * crowding
    quickest = min(config.acceleration_max_px_s2 / (speed * shape.acceleration), FASTEST_OVER_SLOWEST * slowest)
    rate = slowest * max(quickest / slowest, 1.0) ** generator.random()
    return _placed(config, shape, rate, speed, room, generator)


@dataclass(frozen=True)
class _Shape:
    """A closed path over the phase 0 to 2 pi, scaled to a peak speed of 1 per radian."""

    speeds: Float64[np.ndarray, "2 harmonics"]  # amplitudes of the velocity along x and y
    phases: Float64[np.ndarray, "2 harmonics"]
    lowest: Float64[np.ndarray, " 2"]  # lowest position, relative to the centre of the swing
    extent: Float64[np.ndarray, " 2"]
    acceleration: float  # maximum, per radian^2
    peak_phase: float  # where the speed is 1


def _random_shape(generator: np.random.Generator) -> _Shape:
    order = np.arange(1, HARMONICS + 1)
    speeds = generator.standard_normal((2, HARMONICS)) * HARMONIC_SPEEDS
    phases = generator.uniform(0, 2 * math.pi, (2, HARMONICS))
    angles = order[:, None] * PHASES + phases[:, :, None]
    velocity = (speeds[:, :, None] * np.cos(angles)).sum(axis=1)
    speed = np.hypot(*velocity)
    peak = speed.max() * (1 + GRID_SLACK)
    position = (speeds[:, :, None] / order[:, None] * np.sin(angles)).sum(axis=1) / peak
    lowest, extent = position.min(axis=1), position.max(axis=1) - position.min(axis=1)
    acceleration = np.hypot(*(speeds[:, :, None] * order[:, None] * np.sin(angles)).sum(axis=1)) / peak
    peak_phase = float(PHASES[speed.argmax()])
    return _Shape(speeds / peak, phases, lowest, extent, acceleration.max() * (1 + GRID_SLACK), peak_phase)


def _placed(
    config: SynthesizeConfig,
    shape: _Shape,
    rate: float,
    speed: float,
    room: Float64[np.ndarray, " 2"],
    generator: np.random.Generator,
) -> Trajectory:
    """Trajectory along the shape at `rate` radians per second, at a random place within `room`, with roll and zoom."""
    order = np.arange(1, HARMONICS + 1)
    size = _drift_share(config) * speed / rate  # pixels per unit of the shape
    peak_time = generator.uniform(0, config.duration_s)
    phases = shape.phases + order * (shape.peak_phase - rate * peak_time)
    spare = np.maximum(room - size * shape.extent, 0)
    x, y = np.array(_reach(config)) + BORDER_SLACK_PX - size * shape.lowest + spare * generator.random(2)
    amplitudes, rates = size * shape.speeds / order, np.broadcast_to(rate * order, (2, HARMONICS))
    sines = np.stack([amplitudes, rates, phases % (2 * math.pi)], axis=-1).tolist()
    x_sines, y_sines = (tuple(Sine(*sine) for sine in axis) for axis in sines)
    roll = generator.uniform(0, math.radians(config.rotation_max_deg))
    zoom = generator.uniform(0, (config.zoom_max - 1) / 2)
    rolls, zooms = _turn(roll, 2.0, config, speed, generator), _turn(zoom, 3.0, config, speed, generator)
    return Trajectory(float(x), float(y), x_sines, y_sines, rolls, zooms, speed)


def _drift_share(config: SynthesizeConfig) -> float:
    """Share of speed and acceleration left for the sensor's centre by roll and zoom."""
    return 1 - TURN_SHARE * ((config.rotation_max_deg > 0) + (config.zoom_max > 1))


def _turn(
    amplitude: float, coupling: float, config: SynthesizeConfig, speed: float, generator: np.random.Generator
) -> Sine:
    """Roll or zoom that moves the sensor's corners no faster than its share of speed and acceleration allows.

    A pixel q away from the centre sees q exp(i roll) / zoom, whose second derivative is at most
    q (roll'' + 2 roll'^2 + zoom'' + 3 zoom'^2) since zoom >= 1 and 2 roll' zoom' <= roll'^2 + zoom'^2.
    """
    corner = math.hypot(config.sensor_width - 1, config.sensor_height - 1) / 2
    start, hurry = generator.uniform(0, 2 * math.pi), generator.uniform(0.3, 1)
    if amplitude == 0:
        return Sine(0.0, 0.0, 0.0)
    by_speed = TURN_SHARE * speed / (corner * amplitude)
    bending = corner * (amplitude + coupling * amplitude**2)
    by_acceleration = math.sqrt(TURN_SHARE * config.acceleration_max_px_s2 / bending)
    return Sine(amplitude, hurry * min(by_speed, by_acceleration, TURN_RATE_MAX), start)


def _reach(config: SynthesizeConfig) -> tuple[float, float]:
    """Largest distance of the sensor's corners from its centre along x and y, over all rolls, without zoom."""
    half_width, half_height = (config.sensor_width - 1) / 2, (config.sensor_height - 1) / 2
    largest = math.radians(config.rotation_max_deg)

    def reach(along: float, across: float) -> float:
        angle = min(largest, math.atan2(across, along))  # where along cos + across sin is largest
        return along * math.cos(angle) + across * math.sin(angle)

    return reach(half_width, half_height), reach(half_height, half_width)


def frame_times_us(config: SynthesizeConfig) -> list[int]:
    """Times in microseconds of the N + 1 ground-truth frames that bound the N windows of a sequence."""
    windows = round(config.duration_s * config.frame_rate_hz)
    return [round(1e6 * k / config.frame_rate_hz) for k in range(windows + 1)]


def render(
    scene: PolarizationScene,
    trajectory: Trajectory,
    t_s: Float64[np.ndarray, " n"],
    height: int,
    width: int,
    pitch: int = 1,
) -> Float32[Tensor, "n 3 h w"]:
    """(S0, S1, S2) on the moving sensor at times `t_s` in seconds, interpolated bilinearly from those of the scene.

    Pixel centres are at integers in sensor and scene. The camera measures angles from its own axes: rolled clockwise by
    an angle a, it sees a scene whose picture and AoLP are turned by a anticlockwise. Its pixels are `pitch` scene
    pixels apart: 2 for the cells of a DoFP sensor.
    """
    pose = trajectory.pose(np.asarray(t_s, dtype=np.float64))
    return torch.from_numpy(render_poses(scene, pose._replace(zoom=pose.zoom / pitch), height, width))


def render_poses(scene: PolarizationScene, pose: Pose, height: int, width: int) -> Float32[np.ndarray, "n 3 h w"]:
    """As `render`, for a sensor in n poses."""
    frames = np.empty((len(pose.x), 3, height, width), dtype=np.float32)
    _render(np.ascontiguousarray(scene.stokes.numpy()), pose.x, pose.y, pose.angle, pose.zoom, frames)
    return frames


@compiled
def sensor_to_scene(x, y, angle, zoom, height, width):
    """(left, top, along, across) of a sensor whose centre, ((height - 1) / 2, (width - 1) / 2), looks at (x, y).

    Pixel (row, column) looks at (left + column along - row across, top + column across + row along) of the scene.
    """
    along, across = math.cos(angle) / zoom, math.sin(angle) / zoom
    middle_row, middle_column = (height - 1) / 2, (width - 1) / 2
    left = x - middle_column * along + middle_row * across
    top = y - middle_column * across - middle_row * along
    return left, top, along, across


@inlined
def _bilinear(image, x, y):
    """Value of an image between the four pixels around (x, y); exact at integers.

    Outside the image it is extrapolated from the nearest four.
    """
    column = min(max(int(x), 0), image.shape[1] - 2)
    row = min(max(int(y), 0), image.shape[0] - 2)
    right, down = np.float32(x - column), np.float32(y - row)
    left, up = np.float32(1) - right, np.float32(1) - down
    upper = left * image[row, column] + right * image[row, column + 1]
    lower = left * image[row + 1, column] + right * image[row + 1, column + 1]
    return up * upper + down * lower


@compiled
def _render(stokes, x, y, angle, zoom, frames):
    height, width = frames.shape[2:]
    for k in range(len(x)):
        left, top, along, across = sensor_to_scene(x[k], y[k], angle[k], zoom[k], height, width)
        cos, sin = np.float32(math.cos(2 * angle[k])), np.float32(math.sin(2 * angle[k]))
        for row in range(height):
            for column in range(width):
                at_x = left + column * along - row * across
                at_y = top + column * across + row * along
                s1, s2 = _bilinear(stokes[1], at_x, at_y), _bilinear(stokes[2], at_x, at_y)
                frames[k, 0, row, column] = _bilinear(stokes[0], at_x, at_y)
                frames[k, 1, row, column] = s1 * cos - s2 * sin
                frames[k, 2, row, column] = s2 * cos + s1 * sin
