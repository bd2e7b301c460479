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
from polarnet.runtime.machine import generator_for, one_thread
from polarnet.simulation.camera import Camera, grid, pixel_analyzers, weights_of
from polarnet.simulation.emulator import EmulatorConfig, SensorState, emulate_frames
from polarnet.simulation.motion import SynthesizeConfig, frame_times_us, random_trajectory, render
from polarnet.simulation.moving_sensor import (
    channel_light,
    channels_of,
    emulate_motion_steps,
    leave_sensors,
    render_times_us,
)
from polarnet.simulation.scene import PolarizationScene, check_scene, scene_from_rgb, stretched
from polarnet.simulation.upsampling import StokesFrame, upsampled

MOTION_STEPS = 64  # rendered frames in a piece of a moving sensor's simulation
PIECE_PIXELS = 2**20  # pixels of all frames in a piece of a video; light and Stokes parameters take 28 bytes each
MAX_PIECE_FRAMES = 64


class Piece(NamedTuple):
    """A stretch of a simulation: events of the four channels before their readout, and the true frames in it."""

    stop_us: int  # time up to which events are complete
    events: list[Events]
    t_us: Int64[Tensor, " n"]
    stokes: Float32[Tensor, "n 3 h w"]  # true (S0, S1, S2) on the pixels of a channel


def moving_pieces(
    scene: PolarizationScene, motion: SynthesizeConfig, camera: Camera, seed: int, threads: int = 1
) -> Iterator[Piece]:
    """Simulate a moving sensor in pieces; joined and read out (`leave_sensors`), the events are those of `simulate`."""
    trajectory = random_trajectory(motion, scene.height, scene.width, generator_for(seed, "picture", "motion"))
    camera, scene = camera.drawn(seed, "picture"), stretched(scene, motion.dynamic_range)
    size = motion.sensor_height, motion.sensor_width
    pixels = grid(camera.polarizers.layout, *size)
    frames_us = np.array(frame_times_us(motion))
    times_us = render_times_us(trajectory, int(frames_us[-1]), *size, camera.sensor)
    state: SensorState | None = None
    for first in range(0, len(times_us), MOTION_STEPS):
        t_us = times_us[first : first + MOTION_STEPS]
        events, state = emulate_motion_steps(camera, scene, trajectory, t_us, size, state, threads)
        here = frames_us[(frames_us <= t_us[-1]) & (frames_us > (times_us[first - 1] if first else -1))]
        with one_thread():
            stokes = render(scene, trajectory, here * 1e-6, *pixels)
        yield Piece(int(t_us[-1]), events, torch.from_numpy(here), stokes)


def video_pieces(
    frames: Iterable[StokesFrame], camera: Camera, seed: int, upsample: bool = False, threads: int = 1
) -> Iterator[Piece]:
    """Simulate, in pieces, a camera at rest, each pixel of which sees one pixel of the frames; these are the truth.

    The pixels adapt to the first frame. The channels of a DoFP sensor see every second row and column, and their truth
    is the mean of each 2x2 cell. With `upsample`, the sensor also sees interpolated frames (`upsampled`).
    ValueError for frames of different sizes and for times that do not increase.
    """
    camera, source = camera.drawn(seed, "video"), iter(frames)
    head = next(source, None)
    if head is None:
        raise ValueError("expected at least one frame, got none")
    height, width = head.stokes.shape[1:]
    weights = weights_of(camera.polarizers, height, width, camera.key)
    channels = channels_of(camera, (height, width))
    true: list[StokesFrame] = []

    def watched() -> Iterator[StokesFrame]:
        before_us = -1
        for frame in itertools.chain([head], source):
            if frame.stokes.shape != head.stokes.shape:
                raise ValueError(f"expected frames of {height}x{width} px, got {tuple(frame.stokes.shape[1:])}")
            if frame.t_us <= before_us:
                raise ValueError(f"expected times of frames that increase, got {before_us} and {frame.t_us} us")
            before_us = frame.t_us
            true.append(frame)
            yield frame

    length = max(1, min(MAX_PIECE_FRAMES, PIECE_PIXELS // (height * width)))
    seen = upsampled(watched()) if upsample else watched()
    state: SensorState | None = None
    while chunk := list(itertools.islice(seen, length)):
        stokes = torch.stack([frame.stokes for frame in chunk], dim=1).numpy()
        light = np.array([frame.t_us for frame in chunk]), channel_light(stokes, camera.polarizers, weights)
        events, state = emulate_frames(channels, [light], state, threads)
        here = [frame for frame in true if frame.t_us <= chunk[-1].t_us]
        true = true[len(here) :]
        t_us = torch.tensor([frame.t_us for frame in here])
        truth = torch.stack([frame.stokes for frame in here]) if here else torch.empty(0, 3, height, width)
        if height > channels.height:
            truth = torch.nn.functional.avg_pool2d(truth, 2)
        yield Piece(chunk[-1].t_us, events, t_us, truth)


class VideoSimulation(NamedTuple):
    """A camera at rest that sees a video; its fields are those of `Simulation`.

    >>> import torch
    >>> from polarnet.clips import simulate_video
    >>> from polarnet.simulation import POLARIZERS, SENSORS, Camera
    >>> camera = Camera(SENSORS["default"], POLARIZERS["micropolarizers"])
    >>> simulate_video(torch.rand(2, 3, 16, 24), [0, 1000], camera, seed=1).analyzer.shape
    torch.Size([4, 3, 8, 12])
    """

    events: list[Events]
    """Behind the polarizers at 0, 45, 90 and 135 degrees, in microseconds from the first frame."""
    camera: Camera
    """The camera, with the values that it drew where its parameters have ranges (`randomise`)."""
    analyzer: Float32[Tensor, "4 3 *pixels"]
    """Weights of S0, S1 and S2 in the light behind the four polarizers, of each pixel if pixels differ
    (`pixel_analyzers`)."""


def simulate_video(
    frames: Iterable[Float[Array, "3 _h _w"] | PolarizationScene],
    t_us: Sequence[int],
    sensor: EmulatorConfig | Camera,
    seed: int,
    upsample: bool = False,
    threads: int = 1,
) -> VideoSimulation:
    """Simulate a camera at rest, each pixel of which sees one pixel of `frames`.

    Frames are RGB pictures as for `simulate`, or scenes, at whole microseconds `t_us` from 0. With `upsample`,
    interpolated frames are added so that nothing moves by more than about one pixel a step. The number of threads
    changes no event. ValueError for times that do not fit the frames, and as `simulate`.

    >>> import torch
    >>> from polarnet.clips import simulate_video
    >>> from polarnet.simulation import SENSORS
    >>> frames = torch.rand(3, 3, 16, 24)
    >>> [channel.height for channel in simulate_video(frames, [0, 1000, 2000], SENSORS["default"], seed=1).events]
    [16, 16, 16, 16]
    """
    camera = sensor if isinstance(sensor, Camera) else Camera(sensor)
    if len(t_us) == 0 or t_us[0] != 0:
        raise ValueError(f"t_us: expected one time a frame, starting at 0, got {list(t_us[:5])}")
    pieces = list(video_pieces(stokes_frames(frames, t_us), camera, seed, upsample, threads))
    channels = [concatenate(channel) for channel in zip(*(piece.events for piece in pieces), strict=True)]
    pitch, camera = grid(camera.polarizers.layout, 2, 2).pitch, camera.drawn(seed, "video")
    analyzer = pixel_analyzers(camera, pitch * channels[0].height, pitch * channels[0].width)
    return VideoSimulation(leave_sensors(channels, camera, int(t_us[-1])), camera, analyzer)


def stokes_frames(
    frames: Iterable[Float[Array, "3 _h _w"] | PolarizationScene], t_us: Iterable[int]
) -> Iterator[StokesFrame]:
    """Frames with their times; ValueError if there are more or fewer times than frames."""
    for number, (time_us, frame) in enumerate(itertools.zip_longest(t_us, frames)):
        if time_us is None or frame is None:
            more = "more frames" if time_us is None else "more times"
            raise ValueError(f"expected one time a frame, got {more} than {number}; give as many times as frames")
        if isinstance(frame, PolarizationScene):
            check_scene(frame)
        scene = frame if isinstance(frame, PolarizationScene) else scene_from_rgb(frame)
        yield StokesFrame(int(time_us), scene.stokes)
