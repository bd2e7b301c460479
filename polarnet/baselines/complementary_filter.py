"""Intensity from the events of one polarizer by a leaky integrator per pixel (Scheerlinck, Barnes, Mahony, ACCV 2018).

Two filters of the same authors, which "CF with default parameters" can both mean and which differ by decibels of DoLP:
the complementary filter without frames, and the high-pass filter of their events-only package.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from polarnet.events.stream import Events, slice_count
from polarnet.ranges import allowed, check_ranges

HIGHPASS_GAIN = 1.5  # of the high-pass filter's output, I = 1.5 exp(L) - 1: the package's source


@dataclass(frozen=True)
class ComplementaryFilterConfig:
    """Section `baselines.cf` of params.yaml; the published defaults."""

    cutoff_hz: float = field(metadata=allowed(low=0))
    """Below it the scene fades to grey; 0: never."""
    contrast_on: float = field(metadata=allowed(above=0))
    """Step of log intensity of an ON event."""
    contrast_off: float = field(metadata=allowed(high=0))
    intensity_range: list[float]
    """Intensities shown as 0 and 1; the same for the four polarizers, or their ratios would be lost."""

    def __post_init__(self):
        check_ranges(self)
        _check_intensity_range(self.intensity_range)


@dataclass(frozen=True)
class HighPassConfig:
    """Section `baselines.highpass` of params.yaml; the package's defaults, but a fixed intensity range."""

    cutoff_hz: float = field(metadata=allowed(low=0))
    decay_per_event: float = field(metadata=allowed(low=0))
    """Natural logarithm by which a pixel fades at each of its events, whatever their distance in time."""
    contrast_on: float = field(metadata=allowed(above=0))
    contrast_off: float = field(metadata=allowed(high=0))
    intensity_range: list[float]

    def __post_init__(self):
        check_ranges(self)
        _check_intensity_range(self.intensity_range)


class LeakyIntegrator(NamedTuple):
    """What the pixels behind one polarizer remember."""

    log_intensity: Float64[np.ndarray, "h w"]
    """At the pixel's own last event."""
    updated_us: Int64[np.ndarray, "h w"]
    """Time of that event; 0 before the first."""


class Decay(NamedTuple):
    """How fast a pixel forgets, and what an event adds."""

    rate_per_us: float
    per_event: float
    contrast_on: float
    contrast_off: float


def at_rest(height: int, width: int) -> LeakyIntegrator:
    """The state before any event: log intensity 0 at time 0."""
    return LeakyIntegrator(np.zeros((height, width)), np.zeros((height, width), dtype=np.int64))


def integrate(state: LeakyIntegrator, events: Events, decay: Decay) -> LeakyIntegrator:
    """The state after `events`: at each, L <- exp(-omega dt - k) L + c. Earlier than the state: ValueError."""
    log_intensity, updated_us = state.log_intensity.copy(), state.updated_us.copy()
    t, x, y, p = (column.numpy() for column in (events.t, events.x, events.y, events.p))
    in_order = _integrate(log_intensity, updated_us, t, x, y, p, *decay)
    if not in_order:
        raise ValueError("an event is older than one its pixel has seen; sort the events by time")
    return LeakyIntegrator(log_intensity, updated_us)


def log_intensity_at(state: LeakyIntegrator, t_us: int, decay: Decay) -> Float64[np.ndarray, "h w"]:
    """Log intensity at a time after the last event: every pixel decayed from its own last event to `t_us`."""
    return state.log_intensity * np.exp(-decay.rate_per_us * (t_us - state.updated_us))


def reconstruct_cf(
    events: Events, t_us: Int64[Tensor, " t"], config: ComplementaryFilterConfig
) -> Float64[Tensor, "t h w"]:
    """Intensity at rising times from the events up to each (inclusive): I = exp(L) - 1, brought to [0, 1].

    The affine map takes `config.intensity_range` to [0, 1] and clips what lies outside. Times count from the start of
    the recording, when nothing is known.
    """
    decay = Decay(_rate_per_us(config.cutoff_hz), 0.0, config.contrast_on, config.contrast_off)
    return _shown(np.expm1(_log_intensities(events, t_us, decay)), config.intensity_range)


def reconstruct_highpass(events: Events, t_us: Int64[Tensor, " t"], config: HighPassConfig) -> Float64[Tensor, "t h w"]:
    """Like `reconstruct_cf`, with a decay per event and I = 1.5 exp(L) - 1."""
    decay = Decay(_rate_per_us(config.cutoff_hz), config.decay_per_event, config.contrast_on, config.contrast_off)
    return _shown(HIGHPASS_GAIN * np.exp(_log_intensities(events, t_us, decay)) - 1, config.intensity_range)


def _log_intensities(events: Events, t_us: Int64[Tensor, " t"], decay: Decay) -> Float64[np.ndarray, "t h w"]:
    frames = np.empty((len(t_us), events.height, events.width))
    state, start = at_rest(events.height, events.width), 0
    for frame, t, stop in zip(
        frames, t_us.tolist(), torch.searchsorted(events.t, t_us, right=True).tolist(), strict=True
    ):
        state, start = integrate(state, slice_count(events, start, stop), decay), stop
        frame[:] = log_intensity_at(state, t, decay)
    return frames


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


def _shown(intensity: Float64[np.ndarray, "t h w"], intensity_range: Sequence[float]) -> Float64[Tensor, "t h w"]:
    low, high = intensity_range
    return torch.from_numpy(((intensity - low) / (high - low)).clip(0, 1))


def _check_intensity_range(intensity_range: Sequence[float]) -> None:
    if len(intensity_range) != 2 or not intensity_range[0] < intensity_range[1]:
        raise ValueError(f"intensity_range: expected [low, high] with low < high, got {intensity_range}")
