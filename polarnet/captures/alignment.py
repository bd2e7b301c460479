"""Start times of eight captures, finer than the frame interval: events and intensity changes must agree everywhere.

Between two events of a pixel the log intensity changes by one contrast threshold, in the direction of the second event.
How the light varied in between does not matter. An event capture and an intensity capture behind the same polarizer are
aligned when the change between two events, signed by the second, is the same at all pixels. That change is the
threshold. Event sums per picture are unsuitable: each event comes after its change, so the sums are late by
milliseconds.
"""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float32, Float64, Int8, Int64, UInt16

from polarnet.events.stream import Events

DARKEST = 64.0  # of 4095; below it the logarithm is mostly noise
BRIGHT = 400.0  # of 4095; darker pixels respond less than logarithmically and have a different threshold
MAX_CHANGE = 1.0  # natural-log intensity; a larger change between two events is not one threshold step
MAX_STEPS = 300_000
STEP_US = 2_000  # between the lags of the first, coarse search
FINEST_US = 20.0


class Steps(NamedTuple):
    """Pairs of consecutive events of the same pixel within the crop."""

    before_us: Int64[np.ndarray, " n"]
    after_us: Int64[np.ndarray, " n"]
    pixel: Int64[np.ndarray, " n"]
    """Index in row-major order."""
    polarity: Int8[np.ndarray, " n"]
    """Polarity of the second event."""


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


def steps(events: Events, corner: tuple[int, int], crop: tuple[int, int], start_us: int, stop_us: int) -> Steps:
    """Pairs within a crop (size and upper left corner as row, column) and [start_us, stop_us), thinned to 300,000."""
    columns = tuple(column.numpy() for column in (events.t, events.x, events.y, events.p))
    pairs = Steps(*_steps(columns, corner, crop))
    sample = np.flatnonzero((pairs.before_us >= start_us) & (pairs.after_us < stop_us))
    sample = sample[:: max(1, -(-len(sample) // MAX_STEPS))]
    return Steps(*(column[sample] for column in pairs))


def logarithms(pictures: UInt16[np.ndarray, "n h w"]) -> Float32[np.ndarray, "n hw"]:
    """Log intensity, one row per picture and one column per pixel; NaN where it is too dark."""
    values = pictures.reshape(len(pictures), -1).astype(np.float32)
    values[values < DARKEST] = np.nan
    return np.log(values, out=values)


def changes(
    pairs: Steps, lag_us: float | int, t_us: Int64[np.ndarray, " n"], logs: Float32[np.ndarray, "n hw"]
) -> Float64[np.ndarray, " m"]:
    """Change of log intensity over each step, read from the pictures taken at `t_us` with a delay of `lag_us`.

    Intensities between pictures are interpolated. The change is NaN where a step is not between the pictures, or too
    dark.
    """
    return _changes(pairs.before_us, pairs.after_us, pairs.pixel, float(lag_us), t_us.astype(np.float64), logs)


def agreement(polarity: Int8[np.ndarray, " n"], change: Float64[np.ndarray, " n"]) -> float:
    """Correlation of polarities with changes: 1 if every change equals the same threshold.

    Large changes are clipped and NaN is ignored; the result is 0 without any known change.
    """
    known = np.isfinite(change)
    clipped = np.clip(change[known], -MAX_CHANGE, MAX_CHANGE)
    norm = np.sqrt(np.dot(clipped, clipped) * len(clipped))
    return float(np.dot(polarity[known], clipped) / norm) if norm > 0 else 0.0


def spread(polarity: Int8[np.ndarray, " n"], change: Float64[np.ndarray, " n"]) -> float:
    """Variance of the changes signed by their polarities, with large ones clipped.

    Only noise contributes where every change is one threshold. Noise in the pictures does not move the minimum, unlike
    the maximum of `agreement`.
    """
    known = np.isfinite(change)
    return float(np.var(np.clip(polarity[known] * change[known], -MAX_CHANGE, MAX_CHANGE)))


def thresholds(polarity: Int8[np.ndarray, " n"], change: Float64[np.ndarray, " n"]) -> Thresholds:
    """Median change between events, for each polarity of the second event."""
    on, off = (change[np.isfinite(change) & (polarity == sign)] * sign for sign in (1, -1))
    return Thresholds(*(float(np.median(values)) if len(values) else np.nan for values in (on, off)))


def best_lag(
    pairs: Steps, t_us: Int64[np.ndarray, " n"], logs: Float32[np.ndarray, "n hw"], within_us: float | int
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
    bright[pairs.after_us - pairs.before_us < np.median(np.diff(t_us))] = np.nan
    return Lag(lag_us, agreement(pairs.polarity, change), searched, agreements, thresholds(pairs.polarity, bright))


@numba.njit(nogil=True, cache=True)
@no_type_check
def _steps(columns, corner, crop):
    t, x, y, p = columns
    (top, left), (height, width) = corner, crop
    last = np.full(height * width, -1, np.int64)
    before, after, pixel = (np.empty(len(t), np.int64), np.empty(len(t), np.int64), np.empty(len(t), np.int64))
    polarity = np.empty(len(t), np.int8)
    n = 0
    for i in range(len(t)):
        row, column = np.int64(y[i]) - top, np.int64(x[i]) - left
        if 0 <= row < height and 0 <= column < width:
            place = row * width + column
            if last[place] >= 0:
                before[n], after[n], pixel[n], polarity[n] = t[last[place]], t[i], place, p[i]
                n += 1
            last[place] = i
    return before[:n], after[:n], pixel[:n], polarity[:n]


@numba.njit(nogil=True, cache=True)
@no_type_check
def _changes(before, after, pixel, lag, times, logs):
    out = np.full(len(before), np.nan)
    for i in range(len(before)):
        start, stop = before[i] + lag, after[i] + lag
        if start < times[0] or stop > times[-1]:
            continue
        out[i] = _at(stop, pixel[i], times, logs) - _at(start, pixel[i], times, logs)
    return out


@numba.njit(nogil=True, cache=True)
@no_type_check
def _at(t, pixel, times, logs):
    k = min(np.searchsorted(times, t, side="right") - 1, len(times) - 2)
    share = (t - times[k]) / (times[k + 1] - times[k])
    return logs[k, pixel] + share * (logs[k + 1, pixel] - logs[k, pixel])
