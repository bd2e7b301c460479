"""Simulation in pieces: events and truth of a moving sensor, or of a camera that sees a video, in constant memory."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from polarnet.events.stream import Events, concatenate
from polarnet.runtime.arrays import Array
from polarnet.runtime.machine import generator_for, one_thread, seed_for
from polarnet.simulation.camera import Camera
from polarnet.simulation.emulator import MODELS, EmulatorConfig, SensorState, emulate_lights, events_of
from polarnet.simulation.motion import SynthesizeConfig, frame_times_us, random_trajectory, render
from polarnet.simulation.moving_sensor import CHANNELS, emulate_motion_steps, emulation_times_us, leave_sensors
from polarnet.simulation.pixels.light import light_of_frames
from polarnet.simulation.polarizers import channel_size, grid
from polarnet.simulation.rendering import behind_polarizers, split_channels, weights_of
from polarnet.simulation.scene import PolarizationScene, check_scene, scene_from_rgb
from polarnet.simulation.upsampling import StokesFrame, upsampled

MOTION_STEPS = 64  # rendered frames in a piece of a moving sensor's simulation
PIECE_PIXELS = 2**20  # pixels of all frames in a piece of a video; light and Stokes parameters take 28 bytes each
MAX_PIECE_FRAMES = 64


class Piece(NamedTuple):
    """A stretch of a simulation: events of the four channels before their readout, and the true frames in it."""

    stop_us: int
    """Time up to which events are complete."""
    events: list[Events]
    t_us: Int64[Tensor, " n"]
    stokes: Float32[Tensor, "n 3 h w"]
    """True (S0, S1, S2) on the pixels of a channel."""


class Drawn(NamedTuple):
    """Random choices of one simulation: the key of its noise, and its camera."""

    key: int
    camera: Camera


def drawn_camera(camera: Camera, seed: int, name: str) -> Drawn:
    """The camera with the values that it draws from its ranges, and the key of mismatch and noise."""
    return Drawn(seed_for(seed, name, "emulate"), camera.drawn(seed, name))


def moving_pieces(
    scene: PolarizationScene,
    motion: SynthesizeConfig,
    camera: Camera,
    seed: int,
    threads: int = 1,
) -> Iterator[Piece]:
    """Simulate a moving sensor in pieces; joined and read out (`leave_sensors`), the events are those of `simulate`."""
    trajectory = random_trajectory(motion, scene.height, scene.width, generator_for(seed, "picture", "motion"))
    key, camera = drawn_camera(camera, seed, "picture")
    size = motion.sensor_height, motion.sensor_width
    pixels = grid(camera.polarizers.layout, *size)
    frames_us = np.array(frame_times_us(motion))
    times_us = emulation_times_us(trajectory, int(frames_us[-1]), *size, camera.sensor)
    state: SensorState | None = None
    for first in range(0, len(times_us), MOTION_STEPS):
        t_us = times_us[first : first + MOTION_STEPS]
        events, state = emulate_motion_steps(
            scene, trajectory, t_us, *size, camera.sensor, key, state, threads, camera.polarizers
        )
        here = frames_us[(frames_us <= t_us[-1]) & (frames_us > (times_us[first - 1] if first else -1))]
        with one_thread():
            stokes = render(scene, trajectory, here * 1e-6, *pixels)
        yield Piece(int(t_us[-1]), events, torch.from_numpy(here), stokes)


def video_pieces(
    frames: Iterable[StokesFrame],
    camera: Camera,
    seed: int,
    upsample: bool = False,
    threads: int = 1,
) -> Iterator[Piece]:
    """Simulate, in pieces, a camera at rest, each pixel of which sees one pixel of the frames; these are the truth.

    The pixels adapt to the first frame. The channels of a DoFP sensor see every second row and column, and their truth
    is the mean of each 2x2 cell. With `upsample`, the sensor also sees interpolated frames (`upsampled`).
    ValueError for frames of different sizes and for times that do not increase.
    """
    key, camera = drawn_camera(camera, seed, "video")
    source = iter(frames)
    head = next(source, None)
    if head is None:
        raise ValueError("expected at least one frame, got none")
    height, width = head.stokes.shape[1:]
    weights = weights_of(camera.polarizers, height, width, key)
    rows, columns = channel_size(camera.polarizers.layout, height, width)
    true: list[StokesFrame] = []

    def watched() -> Iterator[StokesFrame]:
        for frame in itertools.chain([head], source):
            if frame.stokes.shape != head.stokes.shape:
                raise ValueError(f"expected frames of {height}x{width} px, got {tuple(frame.stokes.shape[1:])}")
            true.append(frame)
            yield frame

    length = max(1, min(MAX_PIECE_FRAMES, PIECE_PIXELS // (height * width)))
    seen, state = upsampled(watched()) if upsample else watched(), None
    while chunk := list(itertools.islice(seen, length)):
        t_us = np.array([frame.t_us for frame in chunk], np.float64)
        stokes = torch.stack([frame.stokes for frame in chunk], dim=1).numpy()
        light = split_channels(behind_polarizers(stokes, weights), camera.polarizers)
        events, state = _advance(light, t_us, rows, columns, camera.sensor, key, state, threads)
        here = [frame for frame in true if frame.t_us <= chunk[-1].t_us]
        true = true[len(here) :] if len(here) < len(true) else []
        yield Piece(chunk[-1].t_us, events, torch.tensor([frame.t_us for frame in here]), _truth(here, rows, columns))


def _advance(
    light: Float32[np.ndarray, "4 n h w"],
    t_us: np.ndarray,
    rows: int,
    columns: int,
    sensor: EmulatorConfig,
    key: int,
    state: SensorState | None,
    threads: int,
) -> tuple[list[Events], SensorState]:
    before = t_us if state is None else np.concatenate([[state.t_us], t_us])
    if (np.diff(before) <= 0).any():
        raise ValueError(f"expected times of frames that increase, got {before[:5].tolist()}... us")
    if MODELS[sensor.model].EIGHT_BIT_VIDEO:
        light = (light + np.float32(0.5)).astype(np.uint8)
    lights = [light_of_frames(np.ascontiguousarray(channel)) for channel in light]
    channels, state = emulate_lights(lights, t_us, rows, columns, sensor, key, state, CHANNELS, threads)
    return [events_of(channel, rows, columns) for channel in channels], state


def _truth(frames: Sequence[StokesFrame], rows: int, columns: int) -> Float32[Tensor, "n 3 h w"]:
    """Stokes parameters on the pixels of a channel."""
    if not frames:
        return torch.empty(0, 3, rows, columns)
    stokes = torch.stack([frame.stokes for frame in frames])
    return stokes if stokes.shape[2] == rows else torch.nn.functional.avg_pool2d(stokes, 2)


def simulate_video(
    frames: Iterable[Float[Array, "3 _h _w"] | PolarizationScene],
    t_us: Sequence[int],
    sensor: EmulatorConfig | Camera,
    seed: int,
    upsample: bool = False,
    threads: int = 1,
) -> list[Events]:
    """Events of the four channels of a camera at rest, each pixel of which sees one pixel of `frames`.

    Frames are RGB pictures as for `simulate`, or scenes. Their times `t_us` are whole microseconds, the first of them
    0. With `upsample`, interpolated frames are added so that nothing moves by more than about one pixel a step. The
    same arguments give the same events on any number of threads. ValueError for times that do not fit the frames, and
    as `simulate`.

    >>> import torch
    >>> from polarnet.clips import simulate_video
    >>> from polarnet.simulation import SENSORS
    >>> frames = torch.rand(3, 3, 16, 24)
    >>> [channel.height for channel in simulate_video(frames, [0, 1000, 2000], SENSORS["default"], seed=1)]
    [16, 16, 16, 16]
    """
    camera = sensor if isinstance(sensor, Camera) else Camera(sensor)
    if len(t_us) == 0 or t_us[0] != 0:
        raise ValueError(f"t_us: expected one time a frame, starting at 0, got {list(t_us[:5])}")
    pieces = list(video_pieces(stokes_frames(frames, t_us), camera, seed, upsample, threads))
    key, camera = drawn_camera(camera, seed, "video")
    channels = [concatenate(channel) for channel in zip(*(piece.events for piece in pieces), strict=True)]
    return leave_sensors(channels, camera.polarizers, camera.readout, key, int(t_us[-1]))


def stokes_frames(
    frames: Iterable[Float[Array, "3 _h _w"] | PolarizationScene], t_us: Iterable[int]
) -> Iterator[StokesFrame]:
    """Frames with their times; ValueError if there are more or fewer times than frames."""
    for number, (time_us, frame) in enumerate(itertools.zip_longest(t_us, frames)):
        if time_us is None or frame is None:
            raise ValueError(
                f"expected one time for each frame, got {'more frames' if time_us is None else 'more times'} than "
                f"{number}; give as many times as frames"
            )
        if isinstance(frame, PolarizationScene):
            check_scene(frame)
            yield StokesFrame(int(time_us), frame.stokes)
        else:
            yield StokesFrame(int(time_us), scene_from_rgb(frame).stokes)
