"""Refine the start times of a target's eight captures on one clock, and measure how well they agree.

Two relations hold for any scene. Behind one polarizer, events and pictures see the same light
(`polarnet.captures.alignment`), which ties the event capture to the intensity capture of each polarizer. Behind all
four, I0 + I90 = I45 + I135 at every time, which ties the four to each other where the scene is polarized. Elsewhere the
four are tied by the landmark's times from the events, which no polarizer changes.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from polarnet.captures.alignment import Lag, best_lag, logarithms, steps
from polarnet.captures.dot import EVENT_CAPTURES, INTENSITY_CAPTURES, IntensityCapture, RecordingsConfig, reduced
from polarnet.events.stream import Events
from polarnet.recordings.source import RecordingError

MAX_PICTURES = 64  # per capture, from the landmark on; bounds the memory of the refinement
LANDMARK_ERROR_US = 500.0  # typical difference between the landmark's times in the events of two captures
REDUNDANCY_SHARE = 1e-3  # share of the samples assumed independent: neighbours in space and time are not
ITERATIONS = 6
POLARIZER_SIGNS = np.array([1.0, -1.0, 1.0, -1.0])  # I0 - I45 + I90 - I135 = 0


class Alignment(NamedTuple):
    """Start times of a target's captures, each by its own clock."""

    start_us: Mapping[str, int]
    lags: Sequence[Lag]
    """Delay of the pictures relative to the events, for each polarizer, from the landmark's starts."""
    residual: float
    """Root mean square of I0 - I45 + I90 - I135 divided by that of the mean intensity, with these starts."""


def refined_starts(
    starts: Mapping[str, int],
    events: Mapping[str, Events],
    intensities: Mapping[str, IntensityCapture],
    config: RecordingsConfig,
    given: Mapping[str, int],
) -> Alignment:
    """Refine the landmark's starts to less than a frame interval; starts `given` by hand stay unchanged.

    Time 0 of the common clock stays: the start times of the four event captures change by 0 on average.
    """
    lags = [
        _lag(events[e], starts[e], intensities[i], starts[i], config)
        for e, i in zip(EVENT_CAPTURES, INTENSITY_CAPTURES, strict=True)
    ]
    picture_us = np.array([starts[i] for i in INTENSITY_CAPTURES]) + [lag.lag_us for lag in lags]
    captures = [intensities[i] for i in INTENSITY_CAPTURES]
    shifts, residual = redundancy_shifts(captures, picture_us, config)
    refined = dict(starts)
    for polarizer, (e, i) in enumerate(zip(EVENT_CAPTURES, INTENSITY_CAPTURES, strict=True)):
        refined[i] = round(picture_us[polarizer] + shifts[polarizer])
        refined[e] = round(starts[e] + shifts[polarizer])
    return Alignment({**refined, **given}, lags, residual)


def redundancy_shifts(
    captures: Sequence[IntensityCapture], start_us: Float64[np.ndarray, " 4"], config: RecordingsConfig
) -> tuple[Float64[np.ndarray, " 4"], float]:
    """Shifts of four intensity captures that best satisfy I0 + I90 = I45 + I135, and the remaining residual.

    The shifts come from linearised least squares (Gauss-Newton) and have mean 0. Shifts that the scene does not
    determine, because all four captures see the same, stay near 0.
    """
    stacks = [_Stack(capture, start, config) for capture, start in zip(captures, start_us.tolist(), strict=True)]
    first, last = max(stack.t_us[0] for stack in stacks), min(stack.t_us[-1] for stack in stacks)
    margin = 1000 * config.refine_within_ms / 2
    count = int((last - first - 2 * margin) / stacks[0].period_us)
    if count < 2:
        raise RecordingError("the intensity captures have too few pictures in common after the landmark to align them")
    t_us = np.linspace(first + margin, last - margin, count)
    shifts = np.zeros(4)
    for _ in range(ITERATIONS):
        values = [stack.at(t_us + shift) for stack, shift in zip(stacks, shifts.tolist(), strict=True)]
        slopes = np.stack([s * v[1].reshape(-1) for s, v in zip(POLARIZER_SIGNS, values, strict=True)], axis=1)
        left = sum(s * v[0].reshape(-1) for s, v in zip(POLARIZER_SIGNS, values, strict=True))
        weight = REDUNDANCY_SHARE / max(float(np.mean(left**2)), 1e-12)
        prior = np.eye(4) / LANDMARK_ERROR_US**2
        shifts = np.linalg.solve(weight * slopes.T @ slopes + prior, weight * slopes.T @ (slopes @ shifts - left))
        shifts -= shifts.mean()
    level = np.sqrt(np.mean(sum(v[0] for v in values) ** 2)) / 4
    return shifts, float(np.sqrt(np.mean(left**2)) / level)


class _Stack:
    """Reduced pictures of a capture from its start on, interpolated to any time of the common clock."""

    def __init__(self, capture: IntensityCapture, start_us: float, config: RecordingsConfig):
        chosen = pictures_after(capture, start_us)
        self.t_us = capture.t_us[chosen] - start_us
        self.period_us = float(np.median(np.diff(self.t_us)))
        self.frames = np.stack([reduced(picture, config) for picture in capture.pictures[chosen]])

    def at(self, t_us: Float64[np.ndarray, " n"]) -> tuple[Float32[np.ndarray, "n h w"], Float32[np.ndarray, "n h w"]]:
        """Pictures and their change per microsecond, by linear interpolation."""
        k = np.clip(np.searchsorted(self.t_us, t_us, side="right") - 1, 0, len(self.t_us) - 2)
        step = self.t_us[k + 1] - self.t_us[k]
        share = np.clip((t_us - self.t_us[k]) / step, 0, 1).astype(np.float32)[:, None, None]
        difference = self.frames[k + 1] - self.frames[k]
        return self.frames[k] + share * difference, difference / step.astype(np.float32)[:, None, None]


def pictures_after(capture: IntensityCapture, start_us: float | int) -> slice:
    """Up to 64 pictures, starting with the last one before `start_us`."""
    first = max(0, int(np.searchsorted(capture.t_us, start_us)) - 1)
    return slice(first, first + MAX_PICTURES)


def _lag(
    events: Events, event_start_us: int, capture: IntensityCapture, picture_start_us: int, config: RecordingsConfig
) -> Lag:
    """Delay of the pictures relative to the events, from these starts."""
    chosen = pictures_after(capture, picture_start_us)
    t_us = capture.t_us[chosen] - picture_start_us + event_start_us
    pairs = steps(events, config.crop_corner, (config.crop[0], config.crop[1]), int(t_us[0]), int(t_us[-1]))
    return best_lag(pairs, t_us, logarithms(capture.pictures[chosen]), 1000 * config.refine_within_ms)
