"""Events of a sensor behind four polarizers that moves over a scene; no clip of frames is stored in between."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float32, Int64

from polarnet.events.mosaic import join_mosaic, split_mosaic
from polarnet.events.stream import Events
from polarnet.simulation.camera import Camera
from polarnet.simulation.emulator import Channels, SensorState, emulate_frames, emulate_lights
from polarnet.simulation.motion import Pose, Trajectory, render_poses
from polarnet.simulation.polarizers import channel_size, weights_of
from polarnet.simulation.readout import read_out
from polarnet.simulation.rendering import channel_light, check_inside, drifts, lights_of_drift, render_times_us
from polarnet.simulation.scene import PolarizationScene
from polarnet.stokes import parse_mosaic

NUMBERS = (0, 1, 2, 3)  # of the channels behind the polarizers at 0, 45, 90 and 135 degrees
CHUNK = 16  # frames rendered at once, unless the sensor only drifts behind uniform polarizers


def emulate_motion(
    camera: Camera,
    scene: PolarizationScene,
    trajectory: Trajectory,
    duration_us: int,
    size: tuple[int, int],
    threads: int = 1,
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
    readout, key = camera.readout, camera.key
    if readout.perfect:
        return channels
    if camera.polarizers.layout == "dofp":
        mosaic = parse_mosaic(camera.polarizers.mosaic)
        return split_mosaic(read_out(join_mosaic(channels, mosaic), readout, key, duration_us)[0], mosaic)
    return [read_out(channel, readout, key + number, duration_us)[0] for number, channel in enumerate(channels)]


def emulate_motion_steps(
    camera: Camera,
    scene: PolarizationScene,
    trajectory: Trajectory,
    t_us: Int64[np.ndarray, " n"],
    size: tuple[int, int],
    state: SensorState | None = None,
    threads: int = 1,
) -> tuple[list[Events], SensorState]:
    """As `emulate_motion` before the readout, for light rendered at times `t_us`; pass the state on to continue.

    If the sensor only drifts behind uniform polarizers, light is rendered row by row as the pixels need it. Otherwise
    it is rendered CHUNK frames at a time. Both interpolate the scene's Stokes parameters like `motion.render`. Raises
    ValueError if the sensor leaves the scene.
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


def channels_of(camera: Camera, size: tuple[int, int]) -> Channels:
    """The four channels of a camera with sensors of this size."""
    return Channels(NUMBERS, *channel_size(camera.polarizers.layout, *size), camera.sensor, camera.key)


def checked_pose(
    scene: PolarizationScene,
    trajectory: Trajectory,
    t_us: Int64[np.ndarray, " n"],
    size: tuple[int, int],
    pitch: int = 1,
) -> Pose:
    """Poses at times in microseconds; ValueError if there is none, if they do not increase or leave the scene."""
    if len(t_us) == 0 or (np.diff(t_us) <= 0).any():
        raise ValueError(f"expected at least one time, and strictly increasing times, got {t_us[:5].tolist()}...")
    pose = trajectory.pose(t_us * 1e-6)
    pose = pose._replace(zoom=pose.zoom / pitch)
    check_inside(scene, pose, t_us, *size)
    return pose


def rendered_chunks(
    scene: PolarizationScene, pose: Pose, t_us: Int64[np.ndarray, " n"], size: tuple[int, int]
) -> Iterator[tuple[Int64[np.ndarray, " k"], Float32[np.ndarray, "3 k h w"]]]:
    """Times and Stokes parameters on a sensor in these poses, CHUNK frames at a time."""
    for first in range(0, len(t_us), CHUNK):
        chunk = slice(first, first + CHUNK)
        yield t_us[chunk], render_poses(scene, Pose(*(values[chunk] for values in pose)), *size).transpose(1, 0, 2, 3)
