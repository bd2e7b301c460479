"""Start times of a target's eight captures on one clock, finer than the frame interval, and how well they agree.

Two relations hold for any scene. Behind one polarizer, events and pictures see the same light, which ties the event
capture to the intensity capture of each polarizer. Behind all four, I0 + I90 = I45 + I135 at every time, which ties the
four to each other where the scene is polarized. Elsewhere the four are tied by the landmark's times from the events,
which no polarizer changes.

Between two events of a pixel the log intensity changes by one contrast threshold, in the direction of the second event.
How the light varied in between does not matter. An event capture and an intensity capture behind the same polarizer are
aligned when the change between two events, signed by the second, is the same at all pixels. That change is the
threshold. Event sums per picture are unsuitable: each event comes after its change, so the sums are late by
milliseconds.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int8, Int64, UInt16

from polarnet.captures.dot import EVENT_CAPTURES, INTENSITY_CAPTURES, IntensityCapture, RecordingsConfig, Target
from polarnet.events.intervals import Intervals, by_pixel, intervals_of
from polarnet.events.stream import Events, crop
from polarnet.recordings.source import RecordingError

DARKEST = 64.0  # of 4095; below it the logarithm is mostly noise
BRIGHT = 400.0  # of 4095; darker pixels respond less than logarithmically and have a different threshold
MAX_CHANGE = 1.0  # natural-log intensity; a larger change between two events is not one threshold step
MAX_STEPS = 300_000
STEP_US = 2_000  # between the lags of the first, coarse search
FINEST_US = 20.0
MAX_PICTURES = 64  # per capture, from the landmark on; bounds the memory of the refinement
LANDMARK_ERROR_US = 500.0  # typical difference between the landmark's times in the events of two captures
REDUNDANCY_SHARE = 1e-3  # share of the samples assumed independent: neighbours in space and time are not
ITERATIONS = 6
POLARIZER_SIGNS = np.array([1.0, -1.0, 1.0, -1.0])  # I0 - I45 + I90 - I135 = 0


class Thresholds(NamedTuple):
    """Contrast thresholds of a channel in its bright pixels, in natural-log intensity; NaN without events."""

    on: float
    off: float


class Lag(NamedTuple):
    """Delay of pictures relative to events beyond the one assumed, with the evidence for it."""

    lag_us: float
    agreement: float
    """Correlation of polarities and changes at `lag_us`, -1 to 1."""
    searched_us: Float64[np.ndarray, " n"]
    """Lags tried by the coarse search."""
    agreements: Float64[np.ndarray, " n"]
    """Agreement at each lag in `searched_us`."""
    thresholds: Thresholds


def steps(events: Events, corner: tuple[int, int], size: tuple[int, int], start_us: int, stop_us: int) -> Intervals:
    """Intervals in a crop (its upper left corner as row, column) and [start_us, stop_us), thinned to 300,000."""
    pairs = intervals_of(by_pixel(crop(events, *corner, *size)))
    pairs = pairs.chosen(np.argsort(pairs.stop_us, kind="stable"))
    sample = np.flatnonzero((pairs.start_us >= start_us) & (pairs.stop_us < stop_us))
    return pairs.chosen(sample[:: max(1, -(-len(sample) // MAX_STEPS))])


def logarithms(pictures: UInt16[np.ndarray, "n h w"]) -> Float32[np.ndarray, "n hw"]:
    """Log intensity, one row per picture and one column per pixel; NaN where it is too dark."""
    values = pictures.reshape(len(pictures), -1).astype(np.float32)
    values[values < DARKEST] = np.nan
    return np.log(values, out=values)


def changes(
    pairs: Intervals, lag_us: float | int, t_us: Int64[np.ndarray, " n"], logs: Float32[np.ndarray, "n hw"]
) -> Float64[np.ndarray, " m"]:
    """Change of log intensity over each step, interpolated between pictures taken at `t_us` with a delay of `lag_us`.

    NaN where a step is not between the pictures, or too dark.
    """
    start, stop = pairs.start_us + lag_us, pairs.stop_us + lag_us
    between = (start >= t_us[0]) & (stop <= t_us[-1])

    def at(t: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        pixel, k = pairs.pixel[between], np.minimum(np.searchsorted(t_us, t, side="right") - 1, len(t_us) - 2)
        share = (t - t_us[k]) / (t_us[k + 1] - t_us[k])
        return logs[k, pixel] + share * (logs[k + 1, pixel] - logs[k, pixel])

    change = np.full(len(start), np.nan)
    change[between] = at(stop[between]) - at(start[between])
    return change


def agreement(polarity: Int8[np.ndarray, " n"], change: Float64[np.ndarray, " n"]) -> float:
    """Correlation of polarities with changes, large ones clipped: 1 if all equal one threshold, 0 if none is known."""
    known = np.isfinite(change)
    clipped = np.clip(change[known], -MAX_CHANGE, MAX_CHANGE)
    norm = np.sqrt(np.dot(clipped, clipped) * len(clipped))
    return float(np.dot(polarity[known], clipped) / norm) if norm > 0 else 0.0


def spread(polarity: Int8[np.ndarray, " n"], change: Float64[np.ndarray, " n"]) -> float:
    """Variance of the changes signed by their polarities, large ones clipped: noise if all changes are one threshold.

    Noise in the pictures does not move its minimum, unlike the maximum of `agreement`.
    """
    known = np.isfinite(change)
    return float(np.var(np.clip(polarity[known] * change[known], -MAX_CHANGE, MAX_CHANGE)))


def thresholds(polarity: Int8[np.ndarray, " n"], change: Float64[np.ndarray, " n"]) -> Thresholds:
    """Median change between events, for each polarity of the second event."""
    on, off = (change[np.isfinite(change) & (polarity == sign)] * sign for sign in (1, -1))
    return Thresholds(*(float(np.median(values)) if len(values) else np.nan for values in (on, off)))


def best_lag(
    pairs: Intervals, t_us: Int64[np.ndarray, " n"], logs: Float32[np.ndarray, "n hw"], within_us: float | int
) -> Lag:
    """Delay of the pictures' clock relative to the events' clock: the lag at which they agree best.

    A coarse search every 2 ms maximises the agreement; Brent's method then minimises the spread, to 20 us.
    """
    from scipy.optimize import minimize_scalar  # half a second, which every stage would pay

    searched = np.arange(-within_us, within_us + STEP_US / 2, STEP_US)
    agreements = np.array([agreement(pairs.polarity, changes(pairs, lag, t_us, logs)) for lag in searched.tolist()])
    best = float(searched[int(agreements.argmax())])
    minimum = minimize_scalar(
        lambda lag_us: spread(pairs.polarity, changes(pairs, lag_us, t_us, logs)),
        bounds=(best - 2 * STEP_US, best + 2 * STEP_US),
        method="bounded",
        options={"xatol": FINEST_US},
    )
    lag_us = float(minimum.x)
    change = changes(pairs, lag_us, t_us, logs)
    bright = changes(pairs, lag_us, t_us, np.where(logs < np.log(np.float32(BRIGHT)), np.float32(np.nan), logs))
    # steps shorter than the frame interval are left out: the light did not change evenly between two pictures
    bright[pairs.duration_us < np.median(np.diff(t_us))] = np.nan
    return Lag(lag_us, agreement(pairs.polarity, change), searched, agreements, thresholds(pairs.polarity, bright))


class Alignment(NamedTuple):
    """Start times of a target's captures, each by its own clock."""

    start_us: Mapping[str, int]
    lags: Sequence[Lag]
    """Delay of the pictures relative to the events, for each polarizer, from the landmark's starts."""
    residual: float
    """Root mean square of I0 - I45 + I90 - I135 divided by that of the mean intensity, with these starts."""


def refined_starts(target: Target, starts: Mapping[str, int], config: RecordingsConfig) -> Alignment:
    """Refine the landmark's starts to less than a frame interval; starts given by hand stay unchanged.

    Time 0 of the common clock stays: the start times of the four event captures change by 0 on average.
    """
    pairs = list(zip(EVENT_CAPTURES, INTENSITY_CAPTURES, strict=True))
    lags = [_lag(target.events[e], starts[e], target.intensities[i], starts[i], config) for e, i in pairs]
    picture_us = np.array([starts[i] for i in INTENSITY_CAPTURES]) + [lag.lag_us for lag in lags]
    shifts, residual = redundancy_shifts([target.intensities[i] for i in INTENSITY_CAPTURES], picture_us, config)
    refined = {i: round(start + shift) for i, start, shift in zip(INTENSITY_CAPTURES, picture_us, shifts, strict=True)}
    refined |= {e: round(starts[e] + shift) for e, shift in zip(EVENT_CAPTURES, shifts, strict=True)}
    return Alignment({**starts, **refined, **target.given}, lags, residual)


def redundancy_shifts(
    captures: Sequence[IntensityCapture], start_us: Float64[np.ndarray, " 4"], config: RecordingsConfig
) -> tuple[Float64[np.ndarray, " 4"], float]:
    """Shifts of four intensity captures that best satisfy I0 + I90 = I45 + I135, and the remaining residual.

    The shifts come from linearised least squares (Gauss-Newton) and have mean 0. Shifts that the scene does not
    determine, because all four captures see the same, stay near 0.
    """
    lines = [
        capture.since(start, config, _pictures_after(capture, start))
        for capture, start in zip(captures, start_us.tolist(), strict=True)
    ]
    slopes_of = [line.derivative() for line in lines]
    first, last = max(line.t[0] for line in lines), min(line.t[-1] for line in lines)
    margin = 1000 * config.refine_within_ms / 2
    count = int((last - first - 2 * margin) / np.median(np.diff(lines[0].t[1:-1])))
    if count < 2:
        raise RecordingError("the intensity captures have too few pictures in common after the landmark to align them")
    t_us = np.linspace(first + margin, last - margin, count)
    shifts = np.zeros(4)
    for _ in range(ITERATIONS):
        values, rates = (
            np.stack([line(t_us + shift).ravel() for line, shift in zip(some, shifts.tolist(), strict=True)], axis=1)
            for some in (lines, slopes_of)
        )
        slopes, left = rates * POLARIZER_SIGNS, values @ POLARIZER_SIGNS
        weight = REDUNDANCY_SHARE / max(float(np.mean(left**2)), 1e-12)
        prior = np.eye(4) / LANDMARK_ERROR_US**2
        shifts = np.linalg.solve(weight * slopes.T @ slopes + prior, weight * slopes.T @ (slopes @ shifts - left))
        shifts -= shifts.mean()
    level = np.sqrt(np.mean(values.mean(axis=1) ** 2))
    return shifts, float(np.sqrt(np.mean(left**2)) / level)


def _pictures_after(capture: IntensityCapture, start_us: float | int) -> slice:
    """Up to 64 pictures, starting with the last one before `start_us`."""
    first = max(0, int(np.searchsorted(capture.t_us, start_us)) - 1)
    return slice(first, first + MAX_PICTURES)


def _lag(
    events: Events, event_start_us: int, capture: IntensityCapture, picture_start_us: int, config: RecordingsConfig
) -> Lag:
    """Delay of the pictures relative to the events, from these starts."""
    chosen = _pictures_after(capture, picture_start_us)
    t_us = capture.t_us[chosen] - picture_start_us + event_start_us
    pairs = steps(events, config.crop_corner, (config.crop[0], config.crop[1]), int(t_us[0]), int(t_us[-1]))
    return best_lag(pairs, t_us, logarithms(capture.pictures[chosen]), 1000 * config.refine_within_ms)
