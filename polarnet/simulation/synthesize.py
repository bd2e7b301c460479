"""From a scene and a motion to the events behind four polarizers of one sensor, without a clip in between."""

import functools
import itertools
import math

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from polarnet.events.stream import Events
from polarnet.simulation.compilation import compiled
from polarnet.simulation.emulator import MODELS, EmulatorConfig, SensorState, emulate_lights, events_of
from polarnet.simulation.motion import Pose, Trajectory, bilinear, window_to_scene
from polarnet.simulation.pixels.columns import Columns
from polarnet.simulation.pixels.light import FULL_SCALE, Light, light_of_frames, light_of_scene
from polarnet.simulation.scene import PolarizationScene
from polarnet.stokes import POLARIZER_ANGLES_DEG, behind_polarizer

POLARIZERS = (0, 1, 2, 3)
SLOWEST_RATE_HZ = 30.0  # of an adaptive rate, for a window that stands still
SAMPLES_PER_STEP = 8  # of the motion, for each pixel it moves
STEP_SLACK = 1e-3  # pixels by which a step may be longer than one
TURNING_CHUNK = 16  # steps that are rendered before their events are made, where the window turns or zooms


def synthesize_sequence(
    scene: PolarizationScene,
    trajectory: Trajectory,
    duration_us: int,
    height: int,
    width: int,
    config: EmulatorConfig,
    key: int,
    threads: int = 1,
) -> list[Events]:
    """Events of the four polarizers of a sensor of height x width pixels that moves over a scene for `duration_us`.

    Times count from the start of the motion. `key` (64 bits) seeds the pixels' mismatch and all noise.
    """
    t_us = render_times_us(trajectory, duration_us, height, width, config)
    events, _ = synthesize_steps(scene, trajectory, t_us, height, width, config, key, None, threads)
    return events


def synthesize_steps(
    scene: PolarizationScene,
    trajectory: Trajectory,
    t_us: Int64[np.ndarray, " n"],
    height: int,
    width: int,
    config: EmulatorConfig,
    key: int,
    state: SensorState | None,
    threads: int = 1,
) -> tuple[list[Events], SensorState]:
    """As `synthesize_sequence`, for light rendered at times `t_us`; hand the state back to go on from there.

    A window that only drifts is rendered row by row as its pixels need it; one that turns or zooms, a few frames at
    a time. Either way light is interpolated between the scene's Stokes parameters, as `motion.render` does.
    ValueError where the window leaves the scene.
    """
    if len(t_us) == 0 or (np.diff(t_us) <= 0).any():
        raise ValueError(f"expected at least one time, and each later than the one before, got {t_us[:5].tolist()}...")
    pose = trajectory.pose(t_us * 1e-6)
    _check_inside(scene, pose, t_us, height, width)
    see = functools.partial(
        emulate_lights, height=height, width=width, config=config, key=key, channels=POLARIZERS, threads=threads
    )
    if _drifts(pose):
        columns, state = see(_lights_of_drift(scene, pose, height, width), t_us.astype(np.float64), state=state)
        return [events_of(c, height, width) for c in columns], state
    pieces = []
    for first in range(0, len(t_us), TURNING_CHUNK):
        chunk = slice(first, first + TURNING_CHUNK)
        frames = render_intensities(scene, Pose(*(values[chunk] for values in pose)), height, width, config)
        lights = [light_of_frames(frames[plane]) for plane in POLARIZERS]
        columns, state = see(lights, t_us[chunk].astype(np.float64), state=state)
        pieces.append(columns)
    joined = [Columns(*map(np.concatenate, zip(*plane, strict=True))) for plane in zip(*pieces, strict=True)]
    assert state is not None  # there was at least one time
    return [events_of(c, height, width) for c in joined], state


def render_times_us(
    trajectory: Trajectory, duration_us: int, height: int, width: int, config: EmulatorConfig
) -> Int64[np.ndarray, " n"]:
    """When the light is rendered, from 0 to `duration_us`: `render_rate_hz` times a second.

    If the rate is null: as often as the window moves by a pixel, and at least 30 times a second.
    Between two pixels of the scene light changes smoothly, and at each pixel its slope jumps. A window that only drifts
    meets the scene's pixels with all of its own at once, so that pixel models which take light at any time see it
    just then: at a fixed rate the nearest of the regular times is moved there.
    """
    samples = 2 + math.ceil(SAMPLES_PER_STEP * duration_us * 1e-6 * max(trajectory.speed_px_s, SLOWEST_RATE_HZ))
    sampled_us = np.linspace(0, duration_us, samples)
    pose = trajectory.pose(sampled_us * 1e-6)
    kinks_us = np.empty(0) if MODELS[config.model].EIGHT_BIT_VIDEO else _pixel_crossings(pose, sampled_us, height, width)
    if config.render_rate_hz is None:
        moved = np.hypot(*np.diff(np.stack(_corners(pose, height, width)), axis=-1)).max(axis=0)
        steps = np.maximum(
            moved * np.maximum(pose.zoom[1:], pose.zoom[:-1]), SLOWEST_RATE_HZ * 1e-6 * np.diff(sampled_us)
        )
        progress = np.concatenate([[0], np.cumsum(steps)])
        anchors = np.unique(np.concatenate([[0, progress[-1]], np.interp(kinks_us, sampled_us, progress)]))
        pieces = [np.linspace(a, b, 1 + math.ceil(b - a - STEP_SLACK)) for a, b in itertools.pairwise(anchors)]
        times = np.interp(np.concatenate(pieces), progress, sampled_us)
    else:
        regular = np.arange(math.ceil(duration_us * 1e-6 * config.render_rate_hz) + 1) * (1e6 / config.render_rate_hz)
        times, nearest = regular.copy(), np.rint(kinks_us * 1e-6 * config.render_rate_hz).astype(int)
        inner = (nearest > 0) & (nearest < len(regular) - 1)
        times[nearest[inner]] = kinks_us[inner]
    times[-1] = duration_us
    return np.unique(np.minimum(np.rint(times), duration_us).astype(np.int64))


def _pixel_crossings(
    pose: Pose, sampled_us: Float64[np.ndarray, " n"], height: int, width: int
) -> Float64[np.ndarray, " m"]:
    """Times at which the pixels of a drifting window lie on rows or columns of the scene's; none if it turns."""
    if not _drifts(pose):
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


def _drifts(pose: Pose) -> bool:
    return bool((pose.angle == 0).all() and (pose.zoom == 1).all())


def render_intensities(
    scene: PolarizationScene, pose: Pose, height: int, width: int, config: EmulatorConfig
) -> UInt8[np.ndarray, "4 n h w"] | Float32[np.ndarray, "4 n h w"]:
    """Digital numbers behind the four polarizers as the window sees them; uint8 where the pixel model wants 8 bits."""
    frames = np.empty((4, len(pose.x), height, width), np.uint8 if MODELS[config.model].EIGHT_BIT_VIDEO else np.float32)
    _render_turning(np.ascontiguousarray(scene.stokes.numpy()), pose.x, pose.y, pose.angle, pose.zoom, frames)
    return frames


@compiled
def _render_turning(stokes, x, y, angle, zoom, frames) -> None:  # pragma: no cover (compiled)
    height, width = frames.shape[2:]
    half, rounding = np.float32(FULL_SCALE / 2), np.float32(0.5 if frames.itemsize == 1 else 0.0)
    for k in range(len(x)):
        left, top, along, across = window_to_scene(x[k], y[k], angle[k], zoom[k], height, width)
        cos, sin = np.float32(math.cos(2 * angle[k])), np.float32(math.sin(2 * angle[k]))
        for row in range(height):
            for column in range(width):
                at_x = left + column * along - row * across
                at_y = top + column * across + row * along
                s0 = bilinear(stokes[0], at_x, at_y)
                s1, s2 = bilinear(stokes[1], at_x, at_y), bilinear(stokes[2], at_x, at_y)
                # the polarizers roll with the camera
                for plane, part in enumerate((s1 * cos + s2 * sin, s2 * cos - s1 * sin)):
                    frames[plane, k, row, column] = max(half * (s0 + part), np.float32(0)) + rounding
                    frames[plane + 2, k, row, column] = max(half * (s0 - part), np.float32(0)) + rounding


def _lights_of_drift(scene: PolarizationScene, pose: Pose, height: int, width: int) -> list[Light]:
    """What falls on the four planes of a window that only drifts, over the part of the scene that it comes to see."""
    left, top = pose.x - (width - 1) / 2, pose.y - (height - 1) / 2
    rows, columns = _seen(top, height, scene.height), _seen(left, width, scene.width)
    # numpy: torch's threads would wait for more work on the cores that the planes' threads are about to use
    s0, s1, s2 = scene.stokes[:, rows, columns].numpy()
    lights = []
    for angle in POLARIZER_ANGLES_DEG:
        plane = np.maximum(behind_polarizer(s0, s1, s2, math.radians(angle)), 0) * FULL_SCALE
        plane = np.pad(plane, (0, 1), mode="edge")
        lights.append(light_of_scene(plane, top - rows.start, left - columns.start))
    return lights


def _seen(first: Float64[np.ndarray, " n"], size: int, limit: int) -> slice:
    """The rows or columns of a scene that a window of `size` needs, whose own first ones lie at `first`."""
    return slice(math.floor(first.min()), min(math.floor(first.max()) + size + 1, limit))


def _corners(pose: Pose, height: int, width: int) -> tuple[Float64[np.ndarray, "4 n"], Float64[np.ndarray, "4 n"]]:
    """Columns and rows of the scene under the window's corner pixels."""
    across = np.array([[-1], [1], [-1], [1]]) * (width - 1) / 2 / pose.zoom
    down = np.array([[-1], [-1], [1], [1]]) * (height - 1) / 2 / pose.zoom
    cos, sin = np.cos(pose.angle), np.sin(pose.angle)
    return pose.x + across * cos - down * sin, pose.y + across * sin + down * cos


def _check_inside(scene: PolarizationScene, pose: Pose, t_us: Int64[np.ndarray, " n"], height: int, width: int) -> None:
    x, y = _corners(pose, height, width)
    outside = ((x < 0) | (x > scene.width - 1) | (y < 0) | (y > scene.height - 1)).any(axis=0)
    if outside.any():
        k = int(outside.argmax())
        raise ValueError(
            f"at {t_us[k]} us a window of {height}x{width} pixels reaches rows {y[:, k].min():.1f} to "
            f"{y[:, k].max():.1f}, columns {x[:, k].min():.1f} to {x[:, k].max():.1f} of a scene of "
            f"{scene.height}x{scene.width}; use a trajectory made for this scene and window"
        )
