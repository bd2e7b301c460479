"""Compiled least-squares fit of each pixel's modulation by a rotating polarizer, for `rotating_polarizer`."""

import functools
import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from polarnet.simulation.compilation import compiled
from polarnet.simulation.pixels.physics import DARK_OFFSET, SATURATION

TWO_PI = 2 * math.pi
UNKNOWNS = 5  # artanh(DoLP) (cos 2 AoLP, sin 2 AoLP), ln(ON and OFF threshold / mean), level: ln(mean light l in DN)
G_STEP, G_SIZE = 0.05, 52  # axis of the lag tables: g = artanh(DoLP) up to 2.55, DoLP up to 0.988
LEVEL_FIRST, LEVEL_STEP, LEVEL_SIZE = math.log(2.0), 0.1, 51  # axis of the lag tables: the level, from 2 to 297 DN
PHASES, SUBSTEPS = 192, 4  # phases per period in the lag table, and steps of its numerical solution per phase
COARSE_NOISE = 0.1  # minimum `noise` of the first fit: larger residuals help it to find the right minimum
RESTART_COST = 0.1  # cost per event above which a pixel restarts from the initial values of the next two lines
RESTART_G = (1.5, 0.3)
RESTART_LEVELS = (6.0, 10.0, 15.0, 23.0, 34.0, 50.0, 75.0, 110.0)  # DN, because the knee makes a minimum at each level
ITERATIONS = 20
CONVERGED = 1e-4  # decrease of the cost in an iteration, below which the fit stops
DAMPING, DAMPING_MIN, DAMPING_MAX, DAMPING_FACTOR = 1e-2, 1e-7, 1e5, 10.0
PIVOT_MIN, G_MIN = 1e-12, 1e-9


class ResponseModel(NamedTuple):
    """Response of the pixels to the light behind the polarizer."""

    log_on: float
    """Natural logarithm of the mean ON threshold."""
    log_off: float
    knee: float
    """DN below which the response is linear."""
    direction: float
    """+1 or -1, the polarizer's sense of rotation."""
    lagged: bool
    lag: Float32[np.ndarray, "g l u"]
    """Response behind the photoreceptor's low-pass minus response, by artanh(DoLP), level and phase."""
    turning_points: Float32[np.ndarray, "2 g l"]
    """Maximum and minimum of the filtered response, minus those of the response."""
    silence_noise: float


class Pixels(NamedTuple):
    """Events of all pixels, one pixel after the other."""

    first: np.ndarray
    """[n + 1], index of each pixel's first event, then the number of events."""
    phase: np.ndarray
    """Twice the polarizer's angle at the event, radians."""
    cos: np.ndarray
    sin: np.ndarray
    p: np.ndarray
    """+1 or -1; 0 for an event before the window."""
    stop: float
    """Phase at the end of the window."""


class Scratch(NamedTuple):
    """Working memory for the fit of a pixel with up to n events."""

    response: np.ndarray
    slope: np.ndarray
    """Derivatives [n 3] of the response by the two components of g and by the level."""
    jacobian: np.ndarray


def response_model(
    threshold_on: float, threshold_off: float, phase_rate: float, cutoff_hz: float, knee: float, silence_noise: float
) -> ResponseModel:
    """Build the model for a phase rate: radians per second of twice the polarizer's angle, negative if that falls."""
    lag, turning_points = _lag_tables(abs(phase_rate), cutoff_hz, knee)
    direction, lagged = math.copysign(1.0, phase_rate), cutoff_hz > 0
    thresholds = math.log(threshold_on), math.log(threshold_off)
    return ResponseModel(*thresholds, knee, direction, lagged, lag, turning_points, silence_noise)


def fit_pixels(
    pixels: Pixels,
    start: Float64[np.ndarray, "n 2"],
    guess: Float64[np.ndarray, "n 3"],
    mean: Float64[np.ndarray, "n 5"],
    precision: Float64[np.ndarray, "n 5"],
    model: ResponseModel,
    noise: float,
) -> tuple[Float64[np.ndarray, "n 5"], Float64[np.ndarray, "n 5 5"], Float64[np.ndarray, " n"]]:
    """Fit the `UNKNOWNS` of each pixel; return them with their covariance and cost.

    `mean` and `precision` are the prior; a pixel with fewer than two events gets `mean`, covariance 0 and cost 0. The
    fit starts from `guess` (g and level of an earlier fit) or, where that is NaN, from g = `start`.
    """
    fitted, cost = mean.copy(), np.zeros(len(mean))
    covariance = np.zeros((len(mean), UNKNOWNS, UNKNOWNS))
    levels = RESTART_LEVELS if model.lagged or model.knee > 0 else ()
    restarts = [(g, math.nan) for g in (math.nan, *RESTART_G)] + [(math.nan, math.log(level)) for level in levels]
    _fit_pixels(pixels, start, guess, mean, precision, model, noise, np.array(restarts), fitted, covariance, cost)
    return fitted, covariance, cost


@functools.lru_cache(maxsize=4)
def _lag_tables(
    phase_rate: float, cutoff_hz: float, knee: float
) -> tuple[Float32[np.ndarray, "g l u"], Float32[np.ndarray, "2 g l"]]:
    """`ResponseModel.lag` and `turning_points` at a phase rate in radians per second.

    The periodic solution of the photoreceptor of `polarnet.simulation.pixels.exact`: a first-order low-pass whose
    bandwidth grows with the light.
    """
    m = np.tanh(G_STEP * np.arange(G_SIZE))[:, None]
    level = np.exp(LEVEL_FIRST + LEVEL_STEP * np.arange(LEVEL_SIZE))[None, :]
    phases = np.linspace(0, TWO_PI, PHASES * SUBSTEPS + 1)
    dt_s = phases[1] / phase_rate
    light = [level * (1 + m * math.cos(phase)) for phase in phases]
    responses = [_responses(one, knee) for one in light]
    lag = np.zeros((len(phases), *responses[0].shape))
    if cutoff_hz > 0:
        rates = [
            math.pi * cutoff_hz * (a + b + 2 * DARK_OFFSET) / SATURATION * dt_s for a, b in itertools.pairwise(light)
        ]
        decays = [np.exp(-rate) for rate in rates]
        falls = [a - b for a, b in itertools.pairwise(responses)]
        drives = [fall * -np.expm1(-rate) / rate for fall, rate in zip(falls, rates, strict=True)]
        start, gain = np.zeros_like(lag[0]), np.ones_like(lag[0])
        for decay, drive in zip(decays, drives, strict=True):
            start, gain = start * decay + drive, gain * decay
        lag[0] = start / (1 - gain)
        for k, (decay, drive) in enumerate(zip(decays, drives, strict=True)):
            lag[k + 1] = lag[k] * decay + drive
    filtered = lag + np.stack(responses)
    peaks = filtered.max(axis=0) - responses[0], filtered.min(axis=0) - responses[PHASES * SUBSTEPS // 2]
    table = np.ascontiguousarray(np.moveaxis(lag[::SUBSTEPS], 0, -1), np.float32)
    return table, np.stack(peaks).astype(np.float32)


def _responses(light: np.ndarray, knee: float) -> np.ndarray:
    logarithm = np.log(np.maximum(light, max(knee, 1e-12)))
    return np.where(light > knee, logarithm, light * (math.log(knee) / knee)) if knee > 0 else logarithm


@compiled
def _response(light, knee):
    """Response to light in DN and its derivative: logarithmic above the knee, linear below."""
    if light > knee:
        return math.log(light), 1 / light
    slope = math.log(knee) / knee
    return light * slope, slope


@compiled
def _cell(g, level):
    """Indices of the table cell that holds (g, level), and the fractions of the cell at which they lie."""
    a = min(g / G_STEP, G_SIZE - 1.001)
    b = min(max((level - LEVEL_FIRST) / LEVEL_STEP, 0.0), LEVEL_SIZE - 1.001)
    return int(a), int(b), a - int(a), b - int(b)


@compiled
def _lag(table, g, level, phase):
    """Lag and its derivatives by g, level and phase."""
    i, j, a, b = _cell(g, level)
    place = phase * (PHASES / TWO_PI)
    place -= math.floor(place / PHASES) * PHASES
    k = min(int(place), PHASES - 1)
    c = place - k
    near, far = table[i], table[i + 1]
    d00, d01 = near[j, k + 1] - near[j, k], near[j + 1, k + 1] - near[j + 1, k]
    d10, d11 = far[j, k + 1] - far[j, k], far[j + 1, k + 1] - far[j + 1, k]
    t00, t01, t10, t11 = near[j, k] + c * d00, near[j + 1, k] + c * d01, far[j, k] + c * d10, far[j + 1, k] + c * d11
    v0, v1 = t00 + b * (t01 - t00), t10 + b * (t11 - t10)
    by_level = ((t01 - t00) * (1 - a) + (t11 - t10) * a) / LEVEL_STEP
    by_phase = ((d00 * (1 - b) + d01 * b) * (1 - a) + (d10 * (1 - b) + d11 * b) * a) * (PHASES / TWO_PI)
    return v0 + a * (v1 - v0), (v1 - v0) / G_STEP, by_level, by_phase


@compiled
def _turning_point(table, g, level):
    i, j, a, b = _cell(g, level)
    near, far = (
        table[i, j] + b * (table[i, j + 1] - table[i, j]),
        table[i + 1, j] + b * (table[i + 1, j + 1] - table[i + 1, j]),
    )
    return near + a * (far - near)


@compiled
def _add(residual, jacobian, normal, gradient):
    """Add a residual to the normal equations; returns its pseudo-Huber cost, quadratic up to about 2."""
    root = math.sqrt(1 + residual * residual / 4)
    for i in range(UNKNOWNS):
        gradient[i] -= residual * jacobian[i] / root
        for j in range(i + 1):
            normal[i, j] += jacobian[i] * jacobian[j] / root
    return 4 * (root - 1)


@compiled
def _evaluate(x, pixels, lo, hi, model, noise, mean, precision, normal, gradient, scratch):
    """Cost of the unknowns `x` for a pixel's events `lo` to `hi`; fills its normal equations."""
    response, slope, jacobian = scratch
    g = math.hypot(x[0], x[1]) + G_MIN
    m, ux, uy, aolp = math.tanh(g), x[0] / g, x[1] / g, math.atan2(x[1], x[0])  # aolp: twice the angle
    level, by_g = math.exp(x[4]), 1 - m * m
    on, off = math.exp(model.log_on + x[2]), math.exp(model.log_off + x[3])
    silence = max(noise, model.silence_noise)
    normal[:], cost = 0.0, 0.0
    for i in range(UNKNOWNS):
        normal[i, i], gradient[i] = precision[i], precision[i] * (mean[i] - x[i])
        cost += precision[i] * (mean[i] - x[i]) ** 2 / 2
    top, top_slope = _response(level * (1 + m), model.knee)
    bottom, bottom_slope = _response(level * (1 - m), model.knee)
    if model.lagged:
        top += _turning_point(model.turning_points[0], g, x[4])
        bottom += _turning_point(model.turning_points[1], g, x[4])
    for k in range(hi - lo + 1):
        if k < hi - lo:
            cos = ux * pixels.cos[lo + k] + uy * pixels.sin[lo + k]
            sin = ux * pixels.sin[lo + k] - uy * pixels.cos[lo + k]
            light = level * (1 + m * cos)
            value, per_light = _response(light, model.knee)
            d_g, d_aolp, d_level = per_light * level * by_g * cos, per_light * level * m * sin, per_light * light
            if model.lagged:
                lag, lag_g, lag_level, lag_phase = _lag(
                    model.lag, g, x[4], model.direction * (pixels.phase[lo + k] - aolp)
                )
                value += lag
                d_g, d_aolp, d_level = d_g + lag_g, d_aolp - model.direction * lag_phase, d_level + lag_level
            response[k] = value
            slope[k, 0] = d_g * ux - d_aolp * uy / g
            slope[k, 1] = d_g * uy + d_aolp * ux / g
            slope[k, 2] = d_level
        if k == 0:
            continue
        before = response[k - 1]
        if k < hi - lo:
            rises = pixels.p[lo + k] > 0
            sign, threshold = (1.0, on) if rises else (-1.0, off)
            change, scale = (response[k] - before) / threshold, 1 / (threshold * noise)
            jacobian[0] = (slope[k, 0] - slope[k - 1, 0]) * scale
            jacobian[1] = (slope[k, 1] - slope[k - 1, 1]) * scale
            jacobian[2], jacobian[3] = (-change / noise, 0.0) if rises else (0.0, -change / noise)
            jacobian[4] = (slope[k, 2] - slope[k - 1, 2]) * scale
            cost += _add((change - sign) / noise, jacobian, normal, gradient)
        # between two events the response must not have left the thresholds at its maximum or minimum
        start, stop = pixels.phase[lo + k - 1] - aolp, (pixels.phase[lo + k] if k < hi - lo else pixels.stop) - aolp
        rise, scale = (top - before) / on, 1 / (on * silence)
        if rise > 1 and math.floor(start / TWO_PI) != math.floor(stop / TWO_PI):
            d_g = top_slope * level * by_g
            jacobian[0], jacobian[1] = (d_g * ux - slope[k - 1, 0]) * scale, (d_g * uy - slope[k - 1, 1]) * scale
            jacobian[2], jacobian[3] = -rise / silence, 0.0
            jacobian[4] = (top_slope * level * (1 + m) - slope[k - 1, 2]) * scale
            cost += _add((rise - 1) / silence, jacobian, normal, gradient)
        fall, scale = (before - bottom) / off, 1 / (off * silence)
        if fall > 1 and math.floor(start / TWO_PI + 0.5) != math.floor(stop / TWO_PI + 0.5):
            d_g = -bottom_slope * level * by_g
            jacobian[0], jacobian[1] = (slope[k - 1, 0] - d_g * ux) * scale, (slope[k - 1, 1] - d_g * uy) * scale
            jacobian[2], jacobian[3] = 0.0, -fall / silence
            jacobian[4] = (slope[k - 1, 2] - bottom_slope * level * (1 - m)) * scale
            cost += _add((fall - 1) / silence, jacobian, normal, gradient)
    return cost


@compiled
def _factorise(normal, damping, factor):
    """Cholesky factor of the normal equations, whose diagonal is enlarged by `damping`."""
    for i in range(UNKNOWNS):
        for j in range(i + 1):
            value = normal[i, j] * (1 + damping) if i == j else normal[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(max(value, PIVOT_MIN)) if i == j else value / factor[j, j]


@compiled
def _solve(factor, right, x):
    for i in range(UNKNOWNS):
        value = right[i]
        for k in range(i):
            value -= factor[i, k] * x[k]
        x[i] = value / factor[i, i]
    for i in range(UNKNOWNS - 1, -1, -1):
        value = x[i]
        for k in range(i + 1, UNKNOWNS):
            value -= factor[k, i] * x[k]
        x[i] = value / factor[i, i]


@compiled
def _descend(x, pixels, lo, hi, model, noise, mean, precision, scratch):
    """Minimise the cost from `x`, in place, by the Levenberg-Marquardt method; return the cost."""
    square = (UNKNOWNS, UNKNOWNS)
    normal, tried_normal, factor = np.zeros(square), np.zeros(square), np.zeros(square)
    gradient, tried_gradient, step = np.zeros(UNKNOWNS), np.zeros(UNKNOWNS), np.zeros(UNKNOWNS)
    cost, damping = _evaluate(x, pixels, lo, hi, model, noise, mean, precision, normal, gradient, scratch), DAMPING
    for _ in range(ITERATIONS):
        _factorise(normal, damping, factor)
        _solve(factor, gradient, step)
        tried = x + step
        now = _evaluate(tried, pixels, lo, hi, model, noise, mean, precision, tried_normal, tried_gradient, scratch)
        if now < cost:
            decrease = cost - now
            x[:], normal[:], gradient[:], cost = tried, tried_normal, tried_gradient, now
            damping = max(damping / DAMPING_FACTOR, DAMPING_MIN)
            if decrease < CONVERGED:
                break
        else:
            damping *= DAMPING_FACTOR
            if damping > DAMPING_MAX:
                break
    return cost


@compiled
def _fit_pixels(pixels, start, guess, mean, precision, model, noise, restarts, fitted, covariance, cost):
    most = 1
    for i in range(len(start)):
        most = max(most, pixels.first[i + 1] - pixels.first[i])
    scratch = Scratch(np.empty(most), np.empty((most, 3)), np.empty(UNKNOWNS))
    normal, factor = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros((UNKNOWNS, UNKNOWNS))
    unit, column, tried = np.zeros(UNKNOWNS), np.zeros(UNKNOWNS), np.zeros(UNKNOWNS)
    coarse = max(noise, COARSE_NOISE)
    for i in range(len(start)):
        lo, hi = pixels.first[i], pixels.first[i + 1]
        if hi - lo < 2:
            continue
        first = mean[i].copy()
        if math.isnan(guess[i, 0]):
            first[0], first[1] = start[i]
        else:
            first[0], first[1], first[4] = guess[i]
        _descend(first, pixels, lo, hi, model, coarse, mean[i], precision[i], scratch)
        cost[i] = _descend(first, pixels, lo, hi, model, noise, mean[i], precision[i], scratch)
        fitted[i] = first
        if cost[i] > RESTART_COST * (hi - lo):
            best, size = np.inf, math.hypot(start[i, 0], start[i, 1]) + G_MIN
            for g, level in restarts:
                x, scale = mean[i].copy(), 1.0 if math.isnan(g) else g / size
                x[0], x[1] = start[i, 0] * scale, start[i, 1] * scale
                x[4] = x[4] if math.isnan(level) else level
                now = _descend(x, pixels, lo, hi, model, coarse, mean[i], precision[i], scratch)
                if now < best:
                    best = now
                    tried[:] = x
            if _descend(tried, pixels, lo, hi, model, noise, mean[i], precision[i], scratch) < cost[i]:
                fitted[i] = tried
        cost[i] = _evaluate(fitted[i], pixels, lo, hi, model, noise, mean[i], precision[i], normal, column, scratch)
        _factorise(normal, 0.0, factor)
        for j in range(UNKNOWNS):
            unit[:] = 0.0
            unit[j] = 1.0
            _solve(factor, unit, column)
            covariance[i, :, j] = column
