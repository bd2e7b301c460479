"""Light on a moving sensor behind four polarizers: the times of rendering, and the light at those times."""

import itertools
import math

import numpy as np
from jaxtyping import Float32, Float64, Int64

from polarnet.simulation.emulator import MODELS, EmulatorConfig
from polarnet.simulation.motion import Pose, Trajectory
from polarnet.simulation.pixels.light import FULL_SCALE, Light
from polarnet.simulation.polarizers import PolarizersConfig, mixed_with_neighbours, split_cells
from polarnet.simulation.scene import PolarizationScene

MIN_RATE_HZ = 30.0  # minimum of the adaptive rate, for a sensor at rest
SAMPLES_PER_STEP = 8  # samples of the motion for each pixel of movement
STEP_SLACK = 1e-3  # pixels by which a step may exceed one pixel


def render_times_us(
    trajectory: Trajectory,
    duration_us: int,
    height: int,
    width: int,
    sensor: EmulatorConfig,
    rotation_rate_hz: float = 0.0,
) -> Int64[np.ndarray, " n"]:
    """Times of the rendered frames, from 0 to `duration_us`, `sensor.render_rate_hz` a second.

    Without a rate, there is one frame for each pixel of motion, and at least MIN_RATE_HZ a second. Light that also
    changes with a rotation is rendered at least `rotation_rate_hz` times a second.
    Light changes smoothly between two pixels of the scene, and its slope jumps at each pixel. All pixels of a drifting
    sensor reach these jumps at once. Unless the times must be regular, for the video of v2e or a rotation, each jump
    gets a frame: an extra one, or the nearest at a rate.
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


def _adaptive_times(
    pose: Pose,
    sampled_us: Float64[np.ndarray, " n"],
    kinks_us: Float64[np.ndarray, " k"],
    corners: tuple[Float64[np.ndarray, "4 n"], Float64[np.ndarray, "4 n"]],
    min_rate_hz: float,
) -> Float64[np.ndarray, " m"]:
    """Times that include all `kinks_us`; between two of them no corner moves by more than one sensor pixel."""
    moved = np.hypot(*np.diff(np.stack(corners), axis=-1)).max(axis=0)
    least = max(MIN_RATE_HZ, min_rate_hz) * 1e-6 * np.diff(sampled_us)
    steps = np.maximum(moved * np.maximum(pose.zoom[1:], pose.zoom[:-1]), least)
    progress = np.concatenate([[0], np.cumsum(steps)])
    anchors = np.unique(np.concatenate([[0, progress[-1]], np.interp(kinks_us, sampled_us, progress)]))
    pieces = [np.linspace(a, b, 1 + math.ceil(b - a - STEP_SLACK)) for a, b in itertools.pairwise(anchors)]
    return np.interp(np.concatenate(pieces), progress, sampled_us)


def _pixel_crossings(
    pose: Pose, sampled_us: Float64[np.ndarray, " n"], height: int, width: int
) -> Float64[np.ndarray, " m"]:
    """Times at which a drifting sensor's pixels lie on rows or columns of the scene; none if it turns or zooms."""
    if not drifts(pose):
        return np.empty(0)
    crossings = []
    for place in (pose.x - (width - 1) / 2, pose.y - (height - 1) / 2):
        before, after = place[:-1], place[1:]
        k = np.flatnonzero(np.floor(before) != np.floor(after))
        line = np.maximum(np.floor(before[k]), np.floor(after[k]))
        crossings.append(
            sampled_us[k] + (line - before[k]) / (after[k] - before[k]) * (sampled_us[k + 1] - sampled_us[k])
        )
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
    rows, columns = _visible(top, height, scene.height), _visible(left, width, scene.width)
    # numpy, because idle torch threads would occupy the cores that the channels' threads need next
    intensities = behind_polarizers(scene.stokes[:, rows, columns].numpy(), weights)
    intensities = np.pad(intensities, ((0, 0), (0, 1), (0, 1)), "edge")
    return [Light(intensity[np.newaxis], top - rows.start, left - columns.start) for intensity in intensities]


def _visible(first: Float64[np.ndarray, " n"], size: int, limit: int) -> slice:
    """Rows (or columns) of a scene that a sensor covers, from the positions of its first row and its size."""
    return slice(math.floor(first.min()), min(math.floor(first.max()) + size + 1, limit))


def _corners(pose: Pose, height: int, width: int) -> tuple[Float64[np.ndarray, "4 n"], Float64[np.ndarray, "4 n"]]:
    """Columns and rows of the scene under the sensor's corner pixels."""
    across = np.array([[-1], [1], [-1], [1]]) * (width - 1) / 2 / pose.zoom
    down = np.array([[-1], [-1], [1], [1]]) * (height - 1) / 2 / pose.zoom
    cos, sin = np.cos(pose.angle), np.sin(pose.angle)
    return pose.x + across * cos - down * sin, pose.y + across * sin + down * cos


def check_inside(scene: PolarizationScene, pose: Pose, t_us: Int64[np.ndarray, " n"], height: int, width: int) -> None:
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
