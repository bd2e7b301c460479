"""Events of a sensor behind four polarizers that moves over a scene; no clip of frames is stored in between."""

import functools

import numpy as np
from jaxtyping import Int64

from polarnet.events.mosaic import join_mosaic, split_mosaic
from polarnet.events.stream import Events
from polarnet.simulation.emulator import MODELS, EmulatorConfig, SensorState, emulate_lights, events_of
from polarnet.simulation.motion import Pose, Trajectory
from polarnet.simulation.pixels.columns import Columns
from polarnet.simulation.pixels.light import light_of_frames
from polarnet.simulation.polarizers import IDEAL, PolarizersConfig, channel_size
from polarnet.simulation.readout import PERFECT, ReadoutConfig, read_out
from polarnet.simulation.rendering import (
    check_inside,
    drifts,
    lights_of_drift,
    render_intensities,
    render_times_us,
    split_channels,
    weights_of,
)
from polarnet.simulation.scene import PolarizationScene
from polarnet.stokes import parse_mosaic

CHANNELS = (0, 1, 2, 3)  # behind the polarizers at 0, 45, 90 and 135 degrees
CHUNK = 16  # frames rendered at once, unless the sensor only drifts behind uniform polarizers


def emulate_motion(
    scene: PolarizationScene,
    trajectory: Trajectory,
    duration_us: int,
    height: int,
    width: int,
    config: EmulatorConfig,
    key: int,
    threads: int = 1,
    polarizers: PolarizersConfig = IDEAL,
    readout: ReadoutConfig = PERFECT,
) -> list[Events]:
    """Events of the four channels of a sensor of height x width pixels that moves over a scene for `duration_us`.

    Times count from the start of the motion. `key` (64 bits) seeds the mismatch of the pixels and all noise. The
    channels of a DoFP sensor (`polarizers.layout`) have half its rows and columns.

    >>> import numpy as np
    >>> import torch
    >>> from polarnet.simulation import MOTIONS, SENSORS, emulate_motion, random_trajectory, scene_from_rgb
    >>> trajectory = random_trajectory(MOTIONS["default"], 240, 320, np.random.default_rng(1))
    >>> scene = scene_from_rgb(torch.rand(3, 240, 320))
    >>> [channel.width for channel in emulate_motion(scene, trajectory, 1000, 120, 180, SENSORS["default"], key=1)]
    [180, 180, 180, 180]
    """
    t_us = emulation_times_us(trajectory, duration_us, height, width, config)
    events, _ = emulate_motion_steps(scene, trajectory, t_us, height, width, config, key, None, threads, polarizers)
    return leave_sensors(events, polarizers, readout, key, duration_us)


def leave_sensors(
    channels: list[Events], polarizers: PolarizersConfig, readout: ReadoutConfig, key: int, duration_us: int
) -> list[Events]:
    """Apply the readout to the four channels of a whole sequence: to four sensors, or to one DoFP sensor.

    `key` and `duration_us` are those of the emulation.
    """
    if readout.perfect:
        return channels
    if polarizers.layout == "dofp":
        mosaic = parse_mosaic(polarizers.mosaic)
        return split_mosaic(read_out(join_mosaic(channels, mosaic), readout, key, duration_us)[0], mosaic)
    return [read_out(channel, readout, key + number, duration_us)[0] for number, channel in enumerate(channels)]


def emulation_times_us(
    trajectory: Trajectory, duration_us: int, height: int, width: int, config: EmulatorConfig
) -> Int64[np.ndarray, " n"]:
    """Times at which light is rendered for the configured pixel model (`render_times_us`)."""
    regular = MODELS[config.model].EIGHT_BIT_VIDEO
    return render_times_us(trajectory, duration_us, height, width, config.render_rate_hz, regular)


def emulate_motion_steps(
    scene: PolarizationScene,
    trajectory: Trajectory,
    t_us: Int64[np.ndarray, " n"],
    height: int,
    width: int,
    config: EmulatorConfig,
    key: int,
    state: SensorState | None,
    threads: int = 1,
    polarizers: PolarizersConfig = IDEAL,
) -> tuple[list[Events], SensorState]:
    """As `emulate_motion`, for light rendered at times `t_us`; pass the returned state to continue.

    If the sensor only drifts behind uniform polarizers, light is rendered row by row as the pixels need it. Otherwise
    it is rendered CHUNK frames at a time. Both interpolate the scene's Stokes parameters like `motion.render`. Raises
    ValueError if the sensor leaves the scene.
    """
    if len(t_us) == 0 or (np.diff(t_us) <= 0).any():
        raise ValueError(f"expected at least one time, and strictly increasing times, got {t_us[:5].tolist()}...")
    pose = trajectory.pose(t_us * 1e-6)
    check_inside(scene, pose, t_us, height, width)
    rows, columns = channel_size(polarizers.layout, height, width)
    eight_bit = MODELS[config.model].EIGHT_BIT_VIDEO
    weights = weights_of(polarizers, height, width, key)
    advance = functools.partial(
        emulate_lights,
        height=rows,
        width=columns,
        config=config,
        key=key,
        channels=CHANNELS,
        threads=threads,
    )
    if drifts(pose) and polarizers.uniform:
        lights = lights_of_drift(scene, pose, height, width, weights)
        channels, state = advance(lights, t_us.astype(np.float64), state=state)
        return [events_of(channel, rows, columns) for channel in channels], state
    pieces = []
    for first in range(0, len(t_us), CHUNK):
        chunk = slice(first, first + CHUNK)
        frames = render_intensities(scene, Pose(*(values[chunk] for values in pose)), height, width, weights)
        frames = split_channels(frames, polarizers)
        if eight_bit:
            frames = (frames + np.float32(0.5)).astype(np.uint8)
        lights = [light_of_frames(channel) for channel in frames]
        channels, state = advance(lights, t_us[chunk].astype(np.float64), state=state)
        pieces.append(channels)
    joined = [Columns(*map(np.concatenate, zip(*channel, strict=True))) for channel in zip(*pieces, strict=True)]
    assert state is not None  # there was at least one time
    return [events_of(channel, rows, columns) for channel in joined], state
