"""Intensity from events by a leaky integrator in every pixel (Scheerlinck, Barnes, Mahony, ACCV 2018).

The module holds two filters by these authors: the complementary filter without frames, and the high-pass filter of
their events-only package. "CF with default parameters" can mean either, and their DoLP differs by decibels.
"""

import functools
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

HIGHPASS_GAIN = 1.5  # output gain of the high-pass filter, from the package's source

Image = Float64[np.ndarray, "c h w"]


@section
class FilterConfig:
    """Sections `methods.cf` and `methods.highpass` of params.yaml, with their authors' defaults."""

    cutoff_hz: NonNegativeFloat
    """Cutoff frequency, below which the scene fades to grey; 0: never."""
    decay_per_event: NonNegativeFloat
    """k >= 0: a pixel's log intensity shrinks by exp(-k) at each of its events, independent of time."""
    contrast_on: PositiveFloat
    """c of an ON event: its step in log intensity."""
    contrast_off: Annotated[float, Field(le=0)]
    intensity_range: list[float]
    """Intensities mapped to 0 and 1, in all four channels."""

    def __post_init__(self):
        if len(self.intensity_range) != 2 or not self.intensity_range[0] < self.intensity_range[1]:
            raise ValueError(f"intensity_range: expected [low, high] with low < high, got {self.intensity_range}")

    @property
    def rate_per_us(self) -> float:
        """Decay rate omega of the log intensity, per microsecond."""
        return 2 * math.pi * self.cutoff_hz * 1e-6


class FilterState(NamedTuple):
    """Leaky integrators: one for each pixel of each channel."""

    log_intensity: Image
    """Log intensity at the last event of each pixel."""
    updated_us: Int64[np.ndarray, "c h w"]
    """Time of that event; 0 before the first."""
    t_us: int
    """Time of the state, at least that of its last event."""


def at_rest(channels: int, height: int, width: int) -> FilterState:
    """State at time 0, before any event: log intensity 0."""
    size = (channels, height, width)
    return FilterState(np.zeros(size), np.zeros(size, dtype=np.int64), 0)


def integrate(state: FilterState, channels: Sequence[Events], t_us: int, config: FilterConfig) -> FilterState:
    """State at `t_us`, after the events since `state`, each of which sets L <- exp(-omega dt - k) L + c.

    The channels are filtered independently. ValueError if an event precedes the last event of its pixel.
    """
    log_intensity, updated_us = state.log_intensity.copy(), state.updated_us.copy()
    settings = config.rate_per_us, config.decay_per_event, config.contrast_on, config.contrast_off
    for number, events in enumerate(channels):
        columns = events.t.numpy(), events.x.numpy(), events.y.numpy(), events.p.numpy()
        if not _integrate(log_intensity[number], updated_us[number], columns, settings):
            raise ValueError("an event is older than the last event of its pixel; sort the events by time")
    return FilterState(log_intensity, updated_us, t_us)


@numba.njit(nogil=True, cache=True)
@no_type_check
def _integrate(log_intensity, updated_us, columns, settings):
    t, x, y, p = columns
    rate_per_us, per_event, contrast_on, contrast_off = settings
    for i in range(len(t)):
        row, column = y[i], x[i]
        elapsed = t[i] - updated_us[row, column]
        if elapsed < 0:
            return False
        step = contrast_on if p[i] > 0 else contrast_off
        decay = math.exp(-rate_per_us * elapsed - per_event)
        log_intensity[row, column] = decay * log_intensity[row, column] + step
        updated_us[row, column] = t[i]
    return True


def highpass_intensity(log_intensity: Image) -> Image:
    """I = 1.5 exp(L) - 1, the high-pass filter's intensity."""
    return HIGHPASS_GAIN * np.exp(log_intensity) - 1


def image_of(state: FilterState, config: FilterConfig, intensity: Callable[[Image], Image]) -> Float64[Tensor, "c h w"]:
    """Intensity at the time of the state, as a function of log intensity: expm1 for the complementary filter.

    `config.intensity_range` becomes [0, 1], intensities outside are clipped.
    """
    logs = -config.rate_per_us * (state.t_us - state.updated_us)
    np.multiply(state.log_intensity, np.exp(logs, out=logs), out=logs)
    low, high = config.intensity_range
    image = intensity(logs)
    image -= low
    image /= high - low
    return torch.from_numpy(image.clip(0, 1, out=image))


def open_filter(setup: Setup, intensity: Callable[[Image], Image]) -> Recoverer:
    """Wrap the filter as a method; each window integrates only the events that no earlier window held."""

    def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        images = []
        for window in windows:
            new = [slice_time(events, state.t_us, window.stop_us) for events in window.channels]
            state = integrate(state, new, window.stop_us, setup.config)
            images.append(image_of(state, setup.config, intensity)[: len(new)])
        return state, from_intensities(torch.stack(images))

    return Recoverer(functools.partial(at_rest, 4), predict, takes_events_once=True)


CF = Method(
    name="cf",
    label="CF",
    colour="#e08a1e",
    open=functools.partial(open_filter, intensity=np.expm1),
    config=FilterConfig,
    reconstructs=True,
    about="The complementary filter without frames (Scheerlinck et al. 2018): intensity from events, one polarizer at "
    "a time, then DoLP by the Stokes formula.",
)
HIGHPASS = Method(
    name="highpass",
    label="high-pass",
    colour="#b0851f",
    open=functools.partial(open_filter, intensity=highpass_intensity),
    config=FilterConfig,
    reconstructs=True,
    about="The high-pass filter (Scheerlinck et al. 2018): intensity from events, one polarizer at a time, then DoLP "
    "by the Stokes formula.",
)
METHODS = (CF, HIGHPASS, with_gain(CF), with_gain(HIGHPASS))
