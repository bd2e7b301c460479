"""Intensity from events by a leaky integrator in every pixel (Scheerlinck, Barnes, Mahony, ACCV 2018).

The module holds two filters by these authors: the complementary filter without frames, and the high-pass filter of
their events-only package. "CF with default parameters" can mean either, and their DoLP differs by decibels.
"""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple, no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float64, Int64
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor

from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import EventWindow
from polarnet.methods.intensities import from_intensities, with_gain
from polarnet.methods.method import Method, Recoverer, Setup, State
from polarnet.runtime.sections import section
from polarnet.stokes import Prediction

HIGHPASS_GAIN = 1.5  # output gain of the high-pass filter, I = 1.5 exp(L) - 1, from the package's source

Step = Callable[..., tuple[Tensor, "FilterState"]]


@section
class ComplementaryFilterConfig:
    """Section `methods.cf` of params.yaml; the published defaults."""

    cutoff_hz: NonNegativeFloat
    """Cutoff frequency, below which the scene fades to grey; 0: never."""
    contrast_on: PositiveFloat
    """Step in log intensity per ON event."""
    contrast_off: Annotated[float, Field(le=0)]
    intensity_range: list[float]
    """Intensities mapped to 0 and 1, in all four channels."""

    def __post_init__(self):
        _check_intensity_range(self.intensity_range)


@section
class HighPassConfig:
    """Section `methods.highpass` of params.yaml; the package's defaults, with a fixed range."""

    cutoff_hz: NonNegativeFloat
    decay_per_event: NonNegativeFloat
    """Natural logarithm of a pixel's decay at each of its events, independent of time."""
    contrast_on: PositiveFloat
    contrast_off: Annotated[float, Field(le=0)]
    intensity_range: list[float]

    def __post_init__(self):
        _check_intensity_range(self.intensity_range)


class LeakyIntegrator(NamedTuple):
    """State of the pixels of one channel."""

    log_intensity: Float64[np.ndarray, "h w"]
    """Log intensity at the last event of each pixel."""
    updated_us: Int64[np.ndarray, "h w"]
    """Time of that event; 0 before the first."""


class Decay(NamedTuple):
    """Decay of a pixel and the step that each event adds."""

    rate_per_us: float
    per_event: float
    contrast_on: float
    contrast_off: float


def at_rest(height: int, width: int) -> LeakyIntegrator:
    """The state before any event: log intensity 0 at time 0."""
    return LeakyIntegrator(np.zeros((height, width)), np.zeros((height, width), dtype=np.int64))


def integrate(state: LeakyIntegrator, events: Events, decay: Decay) -> LeakyIntegrator:
    """State after `events`, each of which sets L <- exp(-omega dt - k) L + c; ValueError if one precedes the state."""
    log_intensity, updated_us = state.log_intensity.copy(), state.updated_us.copy()
    t, x, y, p = (column.numpy() for column in (events.t, events.x, events.y, events.p))
    in_order = _integrate(log_intensity, updated_us, t, x, y, p, *decay)
    if not in_order:
        raise ValueError("an event is older than one its pixel has seen; sort the events by time")
    return LeakyIntegrator(log_intensity, updated_us)


def log_intensity_at(state: LeakyIntegrator, t_us: int, decay: Decay) -> Float64[np.ndarray, "h w"]:
    """Log intensity at `t_us`: every pixel decays from its own last event, which must be earlier."""
    return state.log_intensity * np.exp(-decay.rate_per_us * (t_us - state.updated_us))


class FilterState(NamedTuple):
    """State of a filter between images."""

    pixels: Sequence[LeakyIntegrator]
    """Integrator of each channel."""
    t_us: int
    """Time of the last image."""


def filter_at_rest(channels: int, height: int, width: int) -> FilterState:
    """State of a filter at time 0, before any event."""
    return FilterState([at_rest(height, width)] * channels, 0)


def step_cf(
    state: FilterState, channels: Sequence[Events], t_us: int, config: ComplementaryFilterConfig
) -> tuple[Float64[Tensor, "c h w"], FilterState]:
    """Intensity at `t_us` from the events since the last image: I = exp(L) - 1, scaled to [0, 1].

    Each of the c channels is filtered independently. `config.intensity_range` becomes [0, 1]; intensities outside are
    clipped.
    """
    decay = Decay(_rate_per_us(config.cutoff_hz), 0.0, config.contrast_on, config.contrast_off)
    logs, pixels = _log_intensities(state, channels, t_us, decay)
    return _scaled(np.expm1(logs), config.intensity_range), FilterState(pixels, t_us)


def step_highpass(
    state: FilterState, channels: Sequence[Events], t_us: int, config: HighPassConfig
) -> tuple[Float64[Tensor, "c h w"], FilterState]:
    """Like `step_cf`, with a decay per event and I = 1.5 exp(L) - 1."""
    decay = Decay(_rate_per_us(config.cutoff_hz), config.decay_per_event, config.contrast_on, config.contrast_off)
    logs, pixels = _log_intensities(state, channels, t_us, decay)
    return _scaled(HIGHPASS_GAIN * np.exp(logs) - 1, config.intensity_range), FilterState(pixels, t_us)


def _log_intensities(
    state: FilterState, channels: Sequence[Events], t_us: int, decay: Decay
) -> tuple[Float64[np.ndarray, "c h w"], list[LeakyIntegrator]]:
    pixels = [integrate(before, events, decay) for before, events in zip(state.pixels, channels, strict=True)]
    return np.stack([log_intensity_at(after, t_us, decay) for after in pixels]), pixels


def _scaled(intensity: Float64[np.ndarray, "c h w"], intensity_range: Sequence[float]) -> Float64[Tensor, "c h w"]:
    low, high = intensity_range
    return torch.from_numpy(((intensity - low) / (high - low)).clip(0, 1))


@numba.njit(nogil=True, cache=True)
@no_type_check
def _integrate(log_intensity, updated_us, t, x, y, p, rate_per_us, per_event, contrast_on, contrast_off):
    for i in range(len(t)):
        row, column = y[i], x[i]
        elapsed = t[i] - updated_us[row, column]
        if elapsed < 0:
            return False
        step = contrast_on if p[i] > 0 else contrast_off
        kept = math.exp(-rate_per_us * elapsed - per_event)
        log_intensity[row, column] = kept * log_intensity[row, column] + step
        updated_us[row, column] = t[i]
    return True


def _rate_per_us(cutoff_hz: float) -> float:
    return 2 * math.pi * cutoff_hz * 1e-6


def _check_intensity_range(intensity_range: Sequence[float]) -> None:
    if len(intensity_range) != 2 or not intensity_range[0] < intensity_range[1]:
        raise ValueError(f"intensity_range: expected [low, high] with low < high, got {intensity_range}")


def filtered(step: Step, config: ComplementaryFilterConfig | HighPassConfig) -> Recoverer:
    """Wrap a filter as a method: `step` runs once per window, on the events that no earlier window held."""

    def start(height: int, width: int) -> State:
        return filter_at_rest(4, height, width)

    def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        images = []
        for window in windows:
            new = [slice_time(events, state.t_us, window.stop_us) for events in window.channels]
            image, state = step(state, new, window.stop_us, config)
            images.append(image)
        return state, from_intensities(torch.stack(images))

    return Recoverer(start, predict, takes_events_once=True)


def open_cf(setup: Setup) -> Recoverer:
    """The complementary filter, events only."""
    return filtered(step_cf, setup.config)


def open_highpass(setup: Setup) -> Recoverer:
    """The high-pass filter."""
    return filtered(step_highpass, setup.config)


CF = Method(
    name="cf",
    label="CF",
    colour="#e08a1e",
    open=open_cf,
    config=ComplementaryFilterConfig,
    reconstructs=True,
    about="The complementary filter without frames (Scheerlinck et al. 2018): intensity from events, one polarizer at "
    "a time, then DoLP by the Stokes formula.",
)
HIGHPASS = Method(
    name="highpass",
    label="high-pass",
    colour="#b0851f",
    open=open_highpass,
    config=HighPassConfig,
    reconstructs=True,
    about="The high-pass filter (Scheerlinck et al. 2018): intensity from events, one polarizer at a time, then DoLP "
    "by the Stokes formula.",
)
METHODS = (CF, HIGHPASS, with_gain(CF), with_gain(HIGHPASS))
