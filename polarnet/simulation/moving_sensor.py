"""Events of a sensor behind four polarizers that moves over a scene; no clip of frames is stored in between.

Light is rendered at `render_times_us`: row by row as the pixels need it if the sensor only drifts behind uniform
polarizers, otherwise some frames at a time.
"""

import itertools
import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float32, Float64, Int64

from polarnet.events.stream import Events, join_mosaic, split_mosaic
from polarnet.simulation.camera import (
    Camera,
    PolarizersConfig,
    grid,
    mixed_with_neighbours,
    read_out,
    split_cells,
    weights_of,
)
from polarnet.simulation.emulator import MODELS, Channels, EmulatorConfig, SensorState, emulate_frames, emulate_lights
from polarnet.simulation.motion import Pose, Trajectory, render_poses
from polarnet.simulation.pixels.light import FULL_SCALE, Light
from polarnet.simulation.scene import PolarizationScene
from polarnet.stokes import parse_mosaic

Size = tuple[int, int]
Times = Int64[np.ndarray, " _n"]
Reals = Float64[np.ndarray, " _n"]
Corners = tuple[Float64[np.ndarray, "4 n"], Float64[np.ndarray, "4 n"]]
CHUNK = 16  # frames rendered at once, unless the sensor only drifts behind uniform polarizers
MIN_RATE_HZ = 30.0  # minimum of the adaptive rate, for a sensor at rest
SAMPLES_PER_STEP = 8  # samples of the motion for each pixel of movement
STEP_SLACK = 1e-3  # pixels by which a step may exceed one pixel


def emulate_motion(
    camera: Camera, scene: PolarizationScene, trajectory: Trajectory, duration_us: int, size: Size, threads: int = 1
) -> list[Events]:
    """Events of the four channels of a camera that moves over a scene for `duration_us`.

    Times count from the start of the motion. `size` is the height and width of its sensors in pixels; the channels of
    a DoFP sensor (`polarizers.layout`) have half its rows and columns.

    >>> import numpy as np
    >>> import torch
    >>> from polarnet.simulation import MOTIONS, SENSORS, Camera, emulate_motion, random_trajectory, scene_from_rgb
    >>> trajectory = random_trajectory(MOTIONS["default"], 240, 320, np.random.default_rng(1))
    >>> scene = scene_from_rgb(torch.rand(3, 240, 320))
    >>> channels = emulate_motion(Camera(SENSORS["default"], key=1), scene, trajectory, 1000, (120, 180))
    >>> [channel.width for channel in channels]
    [180, 180, 180, 180]
    """
    t_us = render_times_us(trajectory, duration_us, *size, camera.sensor)
    events, _ = emulate_motion_steps(camera, scene, trajectory, t_us, size, threads=threads)
    return leave_sensors(events, camera, duration_us)


def leave_sensors(channels: list[Events], camera: Camera, duration_us: int) -> list[Events]:
    """Apply the readout to the four channels of a whole sequence: to four sensors, or to one DoFP sensor."""
    readout = camera.readout
    if readout.max_events_per_s is None:
        return channels
    if camera.polarizers.layout == "dofp":
        mosaic = parse_mosaic(camera.polarizers.mosaic)
        return split_mosaic(read_out(join_mosaic(channels, mosaic), readout, duration_us), mosaic)
    return [read_out(channel, readout, duration_us) for channel in channels]


def emulate_motion_steps(
    camera: Camera,
    scene: PolarizationScene,
    trajectory: Trajectory,
    t_us: Times,
    size: Size,
    state: SensorState | None = None,
    threads: int = 1,
) -> tuple[list[Events], SensorState]:
    """As `emulate_motion` before the readout, for light rendered at times `t_us`; pass the state on to continue.

    Light is that of `motion.render`. ValueError if the sensor leaves the scene.
    """
    pose, polarizers = checked_pose(scene, trajectory, t_us, size), camera.polarizers
    channels = channels_of(camera, size)
    weights = weights_of(polarizers, *size, camera.key)
    if drifts(pose) and polarizers.uniform:
        lights = lights_of_drift(scene, pose, *size, weights)
        return emulate_lights(channels, lights, t_us.astype(np.float64), state, threads)
    rendered = rendered_chunks(scene, pose, t_us, size)
    frames = ((times, channel_light(stokes, polarizers, weights)) for times, stokes in rendered)
    return emulate_frames(channels, frames, state, threads)


def channels_of(camera: Camera, size: Size) -> Channels:
    """The four channels of a camera with sensors of this size."""
    return Channels(*grid(camera.polarizers.layout, *size)[:2], camera.sensor, camera.key)


def checked_pose(scene: PolarizationScene, trajectory: Trajectory, t_us: Times, size: Size, pitch: int = 1) -> Pose:
    """Poses at times in microseconds; ValueError if they leave the scene."""
    pose = trajectory.pose(t_us * 1e-6)
    pose = pose._replace(zoom=pose.zoom / pitch)
    check_inside(scene, pose, t_us, *size)
    return pose


def rendered_chunks(
    scene: PolarizationScene, pose: Pose, t_us: Times, size: Size
) -> Iterator[tuple[Int64[np.ndarray, " k"], Float32[np.ndarray, "3 k h w"]]]:
    """Times and Stokes parameters on a sensor in these poses, CHUNK frames at a time."""
    for first in range(0, len(t_us), CHUNK):
        chunk = slice(first, first + CHUNK)
        yield t_us[chunk], render_poses(scene, Pose(*(values[chunk] for values in pose)), *size).transpose(1, 0, 2, 3)


def render_times_us(
    trajectory: Trajectory,
    duration_us: int,
    height: int,
    width: int,
    sensor: EmulatorConfig,
    rotation_rate_hz: float = 0.0,
) -> Times:
    """Times of the rendered frames, from 0 to `duration_us`, `sensor.render_rate_hz` a second.

    Without a rate, there is one frame for each pixel of motion, and at least MIN_RATE_HZ a second; with a rotation, at
    least `rotation_rate_hz`. The slope of light jumps at each pixel of the scene, which all pixels of a drifting sensor
    reach at once. Unless the times must be regular, for the video of v2e or a rotation, each jump gets a frame: an
    extra one, or the nearest at a rate.
    """
    regular = MODELS[sensor.model].EIGHT_BIT_VIDEO or rotation_rate_hz > 0
    samples = 2 + math.ceil(SAMPLES_PER_STEP * duration_us * 1e-6 * max(trajectory.speed_px_s, MIN_RATE_HZ))
    sampled_us = np.linspace(0, duration_us, samples)
    pose = trajectory.pose(sampled_us * 1e-6)
    kinks_us = np.empty(0) if regular else _pixel_crossings(pose, sampled_us, height, width)
    if sensor.render_rate_hz is None:
        times = _adaptive_times(pose, sampled_us, kinks_us, _corners(pose, height, width), rotation_rate_hz)
    else:
        rate_hz = max(sensor.render_rate_hz, rotation_rate_hz)
        even = np.arange(math.ceil(duration_us * 1e-6 * rate_hz) + 1) * (1e6 / rate_hz)
        times, nearest = even.copy(), np.rint(kinks_us * 1e-6 * rate_hz).astype(int)
        inner = (nearest > 0) & (nearest < len(even) - 1)
        times[nearest[inner]] = kinks_us[inner]
    times[-1] = duration_us
    return np.unique(np.minimum(np.rint(times), duration_us).astype(np.int64))


def _adaptive_times(pose: Pose, sampled_us: Reals, kinks_us: Reals, corners: Corners, min_rate_hz: float) -> Reals:
    """Times that include all `kinks_us`; between two of them no corner moves by more than one sensor pixel."""
    moved = np.hypot(*np.diff(np.stack(corners), axis=-1)).max(axis=0)
    least = max(MIN_RATE_HZ, min_rate_hz) * 1e-6 * np.diff(sampled_us)
    steps = np.maximum(moved * np.maximum(pose.zoom[1:], pose.zoom[:-1]), least)
    progress = np.concatenate([[0], np.cumsum(steps)])
    anchors = np.unique(np.concatenate([[0, progress[-1]], np.interp(kinks_us, sampled_us, progress)]))
    pieces = [np.linspace(a, b, 1 + math.ceil(b - a - STEP_SLACK)) for a, b in itertools.pairwise(anchors)]
    return np.interp(np.concatenate(pieces), progress, sampled_us)


def _pixel_crossings(pose: Pose, sampled_us: Reals, height: int, width: int) -> Reals:
    """Times at which a drifting sensor's pixels lie on rows or columns of the scene; none if it turns or zooms."""
    if not drifts(pose):
        return np.empty(0)
    crossings = []
    for place in (pose.x - (width - 1) / 2, pose.y - (height - 1) / 2):
        before, after = place[:-1], place[1:]
        k = np.flatnonzero(np.floor(before) != np.floor(after))
        line = np.maximum(np.floor(before[k]), np.floor(after[k]))
        share = (line - before[k]) / (after[k] - before[k])
        crossings.append(sampled_us[k] + share * (sampled_us[k + 1] - sampled_us[k]))
    return np.sort(np.concatenate(crossings))


def drifts(pose: Pose) -> bool:
    """Whether the sensor never turns or zooms."""
    return bool((pose.angle == 0).all() and (pose.zoom == 1).all())


def channel_light(
    stokes: Float32[np.ndarray, "3 n h w"],
    polarizers: PolarizersConfig,
    weights: Float32[np.ndarray, "sensors 3 *pixels"],
) -> Float32[np.ndarray, "4 n h2 w2"]:
    """Light in DN on the four channels, behind `polarizers` with these weights: a DoFP sensor's split by cells."""
    light = behind_polarizers(stokes, weights)
    if polarizers.layout == "dofp":
        return split_cells(mixed_with_neighbours(light[0], polarizers.crosstalk), polarizers.mosaic)
    return light


def behind_polarizers(
    stokes: Float32[np.ndarray, " 3 *shape"], weights: Float32[np.ndarray, "sensors 3 *pixels"]
) -> Float32[np.ndarray, " sensors *shape"]:
    """Light in DN behind polarizers that weight S0, S1 and S2: alike for a sensor, or for each pixel or frame."""
    s0, s1, s2 = stokes
    return np.maximum(np.stack([a * s0 + b * s1 + c * s2 for a, b, c in weights]), 0) * FULL_SCALE


def lights_of_drift(
    scene: PolarizationScene, pose: Pose, height: int, width: int, weights: Float32[np.ndarray, "sensors 3"]
) -> list[Light]:
    """Light behind the polarizers of a drifting sensor, from the part of the scene that the sensor covers."""
    left, top = pose.x - (width - 1) / 2, pose.y - (height - 1) / 2
    rows = slice(math.floor(top.min()), math.floor(top.max()) + height + 1)
    columns = slice(math.floor(left.min()), math.floor(left.max()) + width + 1)
    # numpy, because idle torch threads would occupy the cores that the channels' threads need next
    intensities = behind_polarizers(scene.stokes[:, rows, columns].numpy(), weights)
    intensities = np.pad(intensities, ((0, 0), (0, 1), (0, 1)), "edge")
    return [Light(intensity[np.newaxis], top - rows.start, left - columns.start) for intensity in intensities]


def _corners(pose: Pose, height: int, width: int) -> Corners:
    """Columns and rows of the scene under the sensor's corner pixels."""
    across = np.array([[-1], [1], [-1], [1]]) * (width - 1) / 2 / pose.zoom
    down = np.array([[-1], [-1], [1], [1]]) * (height - 1) / 2 / pose.zoom
    cos, sin = np.cos(pose.angle), np.sin(pose.angle)
    return pose.x + across * cos - down * sin, pose.y + across * sin + down * cos


def check_inside(scene: PolarizationScene, pose: Pose, t_us: Times, height: int, width: int) -> None:
    """Raise ValueError with the first time at which the sensor leaves the scene."""
    x, y = _corners(pose, height, width)
    outside = ((x < 0) | (x > scene.width - 1) | (y < 0) | (y > scene.height - 1)).any(axis=0)
    if outside.any():
        k = int(outside.argmax())
        raise ValueError(
            f"at {t_us[k]} us a sensor of {height}x{width} pixels reaches rows {y[:, k].min():.1f} to "
            f"{y[:, k].max():.1f}, columns {x[:, k].min():.1f} to {x[:, k].max():.1f} of a scene of "
            f"{scene.height}x{scene.width}; use a trajectory made for this scene and sensor"
        )
