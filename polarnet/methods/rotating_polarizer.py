"""DoLP and AoLP from the events of one sensor behind a rotating polarizer, without calibration or training.

Behind a polarizer at angle theta the light of a pixel is l (1 + DoLP cos 2 (theta - AoLP)). Between two consecutive
events of a pixel the response F to that light, delayed by the photoreceptor, changes by one contrast threshold:

    F(t_i) - F(t_(i-1)) = +threshold_on (ON) or -threshold_off (OFF),

and up to the next event it stays within both thresholds. Each pixel fits DoLP, AoLP, its two thresholds and l to these
equations by least squares (Levenberg-Marquardt with a robust loss). The residuals are relative to the thresholds:
absolute residuals would vanish for DoLP and thresholds of 0. The thresholds have a prior, the mismatch of the sensor.
Their ratio to DoLP follows from the number of events, their size from the shape of the logarithm.
"""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import Field, NonNegativeFloat, PositiveFloat

from polarnet.events.rotation import Rotation
from polarnet.events.stream import Events, merge, slice_time
from polarnet.events.streaming import EventWindow
from polarnet.methods.half_turns import local_mean, local_variance
from polarnet.methods.method import Recoverer
from polarnet.methods.modulation import UNKNOWNS, Pixels, fit_pixels, response_model
from polarnet.runtime.sections import section
from polarnet.stokes import Prediction

INITIAL_RATIO_MAX = 0.7  # limit of q in `_initial_g`, for DoLP 0.94
MISFIT_MAX = 20.0  # limit of one pixel's misfit in the mean over its neighbours
MISFIT_STILL = 0.25  # misfit that a still scene reaches too, because `noise` is larger than what most pixels have
MISFIT_SIDE, SPREAD_SIDE = 5, 3  # pixels; sides of the squares of that mean, and of the variance of DoLP
SILENT_DOLPS = 4000  # nodes of the integral over DoLP of silent pixels
SPREADS = np.linspace(-3, 3, 25)  # nodes of the integral over thresholds, in standard deviations


@section
class ModulationConfig:
    """Section `modulation` of params.yaml: the sensor and the noise that the fit expects."""

    threshold_on: PositiveFloat
    """Mean contrast thresholds, in natural-log intensity."""
    threshold_off: PositiveFloat
    threshold_spread: PositiveFloat
    """Relative standard deviation of the thresholds between pixels."""
    cutoff_hz: NonNegativeFloat
    """Bandwidth of the photoreceptor at full brightness, as in section `emulate`; 0: infinite."""
    knee_dn: NonNegativeFloat
    """Light below which the response is linear instead of logarithmic; 0: logarithmic throughout."""
    level_dn: PositiveFloat
    """Typical mean light behind the polarizer, 0 to 255 DN; matters only with a cutoff or a knee."""
    level_spread: PositiveFloat
    """Standard deviation of the natural logarithm of the mean light between pixels."""
    noise: PositiveFloat
    """Standard deviation of the change between two events, relative to the threshold."""
    silence_noise: PositiveFloat
    """Standard deviation, relative to the threshold, of the largest change without an event, which stays below it."""
    extinction_ratio: Annotated[float, Field(gt=1)] | None
    """Transmission of the polarizer along its axis over that across it; null: infinite."""
    window_turns: PositiveFloat
    """Turns of the polarizer whose events make one frame; there is a frame for each half turn."""
    variance_scale: PositiveFloat
    """Squared error of DoLP over the variance of the fit, measured in simulation (python -m studies.rotating)."""
    variance_floor: PositiveFloat
    """Smallest expected squared error of DoLP."""
    spread_scale: PositiveFloat
    """Squared error of DoLP over its variance among neighbours where the model does not fit, as in moving scenes."""

    @property
    def polarizer_contrast(self) -> float:
        """DoLP that the polarizer makes of fully polarized light."""
        return 1.0 if self.extinction_ratio is None else (self.extinction_ratio - 1) / (self.extinction_ratio + 1)


class ModulationState(NamedTuple):
    """Memory of the pixels [h w] between windows: their thresholds, which outlast the scene, and their last events."""

    log_thresholds: Float64[np.ndarray, "2 h w"]
    """Natural logarithm of the ON and OFF threshold over its mean; `variances` holds its variance."""
    variances: Float64[np.ndarray, "2 h w"]
    last_us: Float64[np.ndarray, "h w"]
    """Time of the last event; NaN before the first."""
    guess: Float64[np.ndarray, "3 h w"]
    """The last fit, from which the next one starts: artanh(DoLP) as a vector, logarithm of the level; NaN: none."""


def initial_state(height: int, width: int, config: ModulationConfig) -> ModulationState:
    """State before the first event: mean thresholds, with the sensor's mismatch."""
    variances = np.full((2, height, width), config.threshold_spread**2)
    last_us, guess = np.full((height, width), np.nan), np.full((3, height, width), np.nan)
    return ModulationState(np.zeros((2, height, width)), variances, last_us, guess)


def fit_modulation(
    events: Events,
    rotation: Rotation,
    start_us: int,
    stop_us: int,
    config: ModulationConfig,
    state: ModulationState | None = None,
) -> tuple[Prediction, ModulationState]:
    """DoLP, AoLP and expected error from the events with start_us <= t < stop_us, and the state after them.

    Maps are float32 [h, w]. A pixel with fewer than two events (the last one before the window counts) gets the mean
    DoLP of silent pixels, AoLP 0 and the variance of that DoLP.
    """
    height, width = events.height, events.width
    state = initial_state(height, width, config) if state is None else state
    pixels, last_us = _pixels_of(slice_time(events, start_us, stop_us), rotation, stop_us, state.last_us.ravel())
    phase_rate = 4 * math.pi * rotation.rate_hz
    model = response_model(
        config.threshold_on, config.threshold_off, phase_rate, config.cutoff_hz, config.knee_dn, config.silence_noise
    )
    mean, precision = _prior(state, config)
    guess = state.guess.reshape(3, -1).T
    start = _initial_g(pixels, config, rotation, stop_us - start_us)
    fitted, covariance, cost = fit_pixels(pixels, start, guess, mean, precision, model, config.noise)
    intervals = np.maximum(np.diff(pixels.first) - 1, 0)
    misfit = 2 * cost / np.maximum(intervals, 1)  # squared residuals over those of the expected noise
    covariance *= np.maximum(1, misfit)[:, None, None]
    active = intervals > 0
    variances = np.where(active[:, None], np.diagonal(covariance, axis1=1, axis2=2)[:, 2:4], np.inf)
    variances = np.minimum(variances, 1 / precision[:, 2:4])  # a window never makes thresholds less certain
    guess = np.where(active[:, None], fitted[:, [0, 1, 4]], np.nan)
    thresholds, variance_maps, guesses = (
        np.moveaxis(c.reshape(height, width, -1), -1, 0) for c in (fitted[:, 2:4], variances, guess)
    )
    after = ModulationState(thresholds, variance_maps, last_us.reshape(height, width), guesses)
    prediction = _prediction(fitted, covariance, active, config, (height, width))
    return _with_misfit(prediction, misfit.reshape(height, width), config), after


def _with_misfit(prediction: Prediction, misfit: Float64[np.ndarray, "h w"], config: ModulationConfig) -> Prediction:
    """Add the variance of DoLP among neighbours to the expected error, as far as the model does not fit there.

    A scene that moves, or light below the knee, misfits at all its pixels. The error is then about as large as DoLP
    differs around the pixel, while the residuals of one pixel tell little about it.
    """
    assert prediction.log_variance is not None
    local = (local_mean(torch.from_numpy(np.minimum(misfit, MISFIT_MAX)), MISFIT_SIDE) - MISFIT_STILL).clamp(min=0)
    spread = config.spread_scale * local_variance(prediction.dolp, SPREAD_SIDE) * local / (1 + local)
    return prediction._replace(log_variance=(prediction.log_variance.exp() + spread).log().float())


def rotating_recoverer(config: ModulationConfig, rotation: Rotation) -> Recoverer:
    """Wrap the fit as a method; the sensor's events may be in any channel, and the other channels are empty."""

    def start(height: int, width: int) -> ModulationState:
        return initial_state(height, width, config)

    def predict(state: ModulationState, windows: Sequence[EventWindow]) -> tuple[ModulationState, Prediction]:
        predictions = []
        for window in windows:
            events = merge(window.channels)
            prediction, state = fit_modulation(events, rotation, window.start_us, window.stop_us, config, state)
            predictions.append(prediction)
        maps = [torch.stack([getattr(one, name) for one in predictions]) for name in ("dolp", "aolp", "log_variance")]
        return state, Prediction(*maps)

    return Recoverer(start, predict)


def silent_dolp(config: ModulationConfig) -> tuple[float, float]:
    """Mean and variance of the DoLP of a pixel that never fires, if all DoLP are equally probable.

    The light swings by ln((1 + DoLP) / (1 - DoLP)). The pixel stays silent if this swing fits between its thresholds,
    and its reference level may lie anywhere between them.
    """
    dolp = (np.arange(SILENT_DOLPS) + 0.5) / SILENT_DOLPS
    swing = 2 * np.arctanh(dolp * config.polarizer_contrast)
    room = config.threshold_on + config.threshold_off
    spread = config.threshold_spread * math.hypot(config.threshold_on, config.threshold_off)
    rooms = np.maximum(room + spread * SPREADS, spread)
    weights = np.exp(-(SPREADS**2) / 2)
    silent = (np.maximum(0, 1 - swing[:, None] / rooms) * weights).sum(axis=1)
    mean = float((silent * dolp).sum() / silent.sum())
    return mean, float((silent * (dolp - mean) ** 2).sum() / silent.sum())


def _prior(
    state: ModulationState, config: ModulationConfig
) -> tuple[Float64[np.ndarray, "n 5"], Float64[np.ndarray, "n 5"]]:
    """Prior mean and precision (1 / variance) of the unknowns (`modulation.UNKNOWNS`) before a window."""
    count = state.last_us.size
    mean, precision = np.zeros((count, UNKNOWNS)), np.ones((count, UNKNOWNS))
    mean[:, 2:4], precision[:, 2:4] = state.log_thresholds.reshape(2, -1).T, 1 / state.variances.reshape(2, -1).T
    mean[:, 4], precision[:, 4] = math.log(config.level_dn), config.level_spread**-2
    return mean, precision


def _prediction(
    fitted: np.ndarray, covariance: np.ndarray, active: np.ndarray, config: ModulationConfig, size: tuple[int, int]
) -> Prediction:
    g = np.hypot(fitted[:, 0], fitted[:, 1])
    modulation = np.tanh(g)
    direction = fitted[:, :2] / np.maximum(g, 1e-9)[:, None]
    along = np.einsum("ni,nij,nj->n", direction, covariance[:, :2, :2], direction)
    contrast = config.polarizer_contrast
    variance = along * ((1 - modulation**2) / contrast) ** 2
    silent, silent_variance = silent_dolp(config)
    dolp = np.where(active, np.minimum(modulation / contrast, 1), silent)
    expected = np.minimum(config.variance_scale * variance, 1) + config.variance_floor
    log_variance = np.log(np.where(active, expected, silent_variance))
    aolp = np.where(active, np.arctan2(fitted[:, 1], fitted[:, 0]) / 2 % math.pi, 0).astype(np.float32)
    aolp = np.where(aolp >= np.float32(math.pi), np.float32(0), aolp)
    return Prediction(*(torch.from_numpy(x.astype(np.float32).reshape(size)) for x in (dolp, aolp, log_variance)))


def _pixels_of(
    events: Events, rotation: Rotation, stop_us: int, last_us: Float64[np.ndarray, " n"]
) -> tuple[Pixels, Float64[np.ndarray, " n"]]:
    """Events sorted by pixel, after the pixel's last event of earlier windows; and the new time of its last event."""
    pixel = events.y.numpy().astype(np.int64) * events.width + events.x.numpy()
    remembered = np.flatnonzero(~np.isnan(last_us))
    t_us = np.concatenate([last_us[remembered], events.t.numpy().astype(np.float64)])
    p = np.concatenate([np.zeros(len(remembered), np.int8), events.p.numpy()])
    pixel = np.concatenate([remembered, pixel])
    order = np.argsort(pixel, kind="stable")
    first = np.searchsorted(pixel[order], np.arange(len(last_us) + 1))
    phase = 2 * rotation.at(t_us[order])
    latest = last_us.copy()
    filled = np.flatnonzero(np.diff(first))
    latest[filled] = t_us[order][first[1:][filled] - 1]
    stop = float(2 * rotation.at(np.array([stop_us]))[0])
    return Pixels(first, phase, np.cos(phase), np.sin(phase), p[order], stop), latest


def _initial_g(
    pixels: Pixels, config: ModulationConfig, rotation: Rotation, duration_us: int
) -> Float64[np.ndarray, "n 2"]:
    """Initial g = artanh(m) (cos 2 AoLP, sin 2 AoLP) of each pixel, from the first Fourier coefficient of its events.

    ln(1 + m cos x) with m = 2 q / (1 + q^2) has the first coefficient 2 q.
    """
    count = len(pixels.first) - 1
    owner = np.repeat(np.arange(count), np.diff(pixels.first))
    step = np.select([pixels.p > 0, pixels.p < 0], [config.threshold_on, -config.threshold_off], 0.0)
    periods = max(duration_us / rotation.half_turn_us, 0.5)
    sine, cosine = (np.bincount(owner, step * f, count) for f in (pixels.sin, pixels.cos))
    phase = np.arctan2(cosine, -sine) if rotation.rate_hz > 0 else np.arctan2(-cosine, sine)
    q = np.minimum(np.hypot(sine, cosine) / (2 * math.pi * periods), INITIAL_RATIO_MAX)
    g = np.arctanh(2 * q / (1 + q * q))
    return np.stack([g * np.cos(phase), g * np.sin(phase)], axis=1)
