"""`polarnet recover --rotating`: the recording of one camera behind a rotating polarizer."""

import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from polarnet.events.rotation import Rotation, steady_rotation, triggered_rotation
from polarnet.events.stream import Events, downscale
from polarnet.events.streaming import WindowRule
from polarnet.recordings.formats import hdf5
from polarnet.recordings.live import Piece
from polarnet.recordings.recording import Recording
from polarnet.recordings.source import RecordingError
from polarnet.recovery.stream import Input

EMPTY_CHANNELS = 3  # windows have four channels; the one camera is the first


def open_rotating(
    path: Path, rotation: Rotation, read: Callable[[Path], Recording], size: tuple[int, int] | None
) -> tuple[Input, Rotation]:
    """Read the camera's events, reduced to `size` (height, width) if given, and count times from the first event.

    `rotation` is by the file's clock, the returned one by that of the events. RecordingError for a file without events.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    events = read(path).events
    if not len(events):
        raise RecordingError(f"{path.name}: expected events, the file has none")
    start_us = int(events.t[0])
    shifted = Events(events.t - start_us, events.x, events.y, events.p, events.height, events.width)
    if size is not None:
        shifted = downscale(shifted, *size, keep_rate=True)
    duration_us = int(shifted.t[-1]) + 1
    channels = [shifted, *[Events.empty(shifted.height, shifted.width)] * EMPTY_CHANNELS]
    pieces = [Piece(channels, duration_us, time.perf_counter())]
    return Input(path.name, shifted.height, shifted.width, pieces, duration_us), rotation.since(start_us)


def rotation_of(rate_hz: float | None, triggers: Path | None, start_angle_deg: float) -> Rotation:
    """The rotation at `rate_hz` from time 0 of the file, or through one trigger a turn.

    `triggers` is a text file with a time in microseconds on each line, or an HDF5 file with a table /triggers.
    With both, the rate gives the sense of rotation. ValueError if there are fewer than two triggers.
    """
    start_angle = math.radians(start_angle_deg)
    if triggers is None:
        if rate_hz is None:
            raise ValueError("expected the rate of the polarizer (--rotating HZ) or its triggers (--triggers FILE)")
        return steady_rotation(rate_hz, start_angle)
    turn = 1.0 if rate_hz is None else math.copysign(1.0, rate_hz)
    return triggered_rotation(_trigger_times_us(triggers), start_angle, turn)


def half_turn_rule(
    rotation: Rotation, window_turns: float, length_us: int | None = None, step_us: int | None = None
) -> WindowRule:
    """Windows as long as `length_us` (default: `window_turns` turns), one every `step_us` (default: half a turn)."""
    step_us = step_us or max(1, round(rotation.half_turn_us))
    length_us = length_us or max(step_us, round(2 * window_turns * rotation.half_turn_us))
    return WindowRule(length_us, None, min(step_us, length_us))


def _trigger_times_us(path: Path) -> np.ndarray:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    with path.open("rb") as file:
        if file.read(len(hdf5.MAGIC)) == hdf5.MAGIC:
            return hdf5.trigger_times_us(path)
    try:
        return np.array([int(line) for line in path.read_text().split()], np.int64)
    except ValueError:
        raise RecordingError(f"{path.name}: expected a time in whole microseconds on each line") from None
