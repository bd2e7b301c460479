"""Intensity from events by a leaky integrator behind every pixel (Scheerlinck, Barnes, Mahony, ACCV 2018).

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
ROBUST = (0.0025, 0.9975)  # quantiles that the package takes for an image's darkest and brightest
FOLLOWED_S = 2.0  # after this long ...
FOLLOWED = 0.95  # ... its automatic range has followed so much of a change
RANGE_RULES = ("fixed", "common", "per_polarizer")


@dataclass(frozen=True)
class ComplementaryFilterConfig:
    """Section `baselines.cf` of params.yaml; the published defaults."""

    cutoff_hz: float = field(metadata=allowed(low=0))
    """Below it the scene fades to grey; 0: never."""
    contrast_on: float = field(metadata=allowed(above=0))
    """Step of log intensity of an ON event."""
    contrast_off: float = field(metadata=allowed(high=0))
    intensity_range: list[float]
    """Intensities shown as 0 and 1; where an automatic range starts from."""
    range_rule: str = field(metadata=allowed(choices=RANGE_RULES))
    """fixed: `intensity_range`, for the four polarizers alike; common: a range that follows the images, one for the
    four; per_polarizer: one for each, which loses the ratios between them that Stokes parameters need."""

    def __post_init__(self):
        check_ranges(self)
        _check_intensity_range(self.intensity_range)


@dataclass(frozen=True)
class HighPassConfig:
    """Section `baselines.highpass` of params.yaml; the package's defaults, but for the range, automatic there."""

    cutoff_hz: float = field(metadata=allowed(low=0))
    decay_per_event: float = field(metadata=allowed(low=0))
    """Natural logarithm by which a pixel fades at each of its events, whatever their distance in time."""
    contrast_on: float = field(metadata=allowed(above=0))
    contrast_off: float = field(metadata=allowed(high=0))
    intensity_range: list[float]
    range_rule: str = field(metadata=allowed(choices=RANGE_RULES))

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
    channels: Sequence[Events], t_us: Int64[Tensor, " t"], config: ComplementaryFilterConfig
) -> Float64[Tensor, "t c h w"]:
    """Intensity at rising times from the events up to each (inclusive): I = exp(L) - 1, brought to [0, 1].

    Each of the c channels, the polarizers of a recording, is filtered by itself. What `config.range_rule` says is
    shown as 0 and 1, and what lies outside is clipped. Times count from the start of the recording, when nothing is
    known.
    """
    decay = Decay(_rate_per_us(config.cutoff_hz), 0.0, config.contrast_on, config.contrast_off)
    return _shown(np.expm1(_log_intensities(channels, t_us, decay)), t_us, config.intensity_range, config.range_rule)


def reconstruct_highpass(
    channels: Sequence[Events], t_us: Int64[Tensor, " t"], config: HighPassConfig
) -> Float64[Tensor, "t c h w"]:
    """Like `reconstruct_cf`, with a decay per event and I = 1.5 exp(L) - 1."""
    decay = Decay(_rate_per_us(config.cutoff_hz), config.decay_per_event, config.contrast_on, config.contrast_off)
    intensity = HIGHPASS_GAIN * np.exp(_log_intensities(channels, t_us, decay)) - 1
    return _shown(intensity, t_us, config.intensity_range, config.range_rule)


def following_ranges(
    darkest: Float64[np.ndarray, "t c"],
    brightest: Float64[np.ndarray, "t c"],
    t_us: Int64[Tensor, " t"],
    start: Sequence[float],
) -> Float64[np.ndarray, "2 t c"]:
    """Ranges that begin as `start` at time 0 and follow the images' own as a low-pass filter: 95 % in 2 s."""
    ranges = np.empty((2, *darkest.shape))
    current, before = np.array(start)[:, None] + np.zeros(darkest.shape[1]), 0
    for i, t in enumerate(t_us.tolist()):
        kept = (1 - FOLLOWED) ** ((t - before) * 1e-6 / FOLLOWED_S)
        current, before = kept * current + (1 - kept) * np.stack([darkest[i], brightest[i]]), t
        ranges[:, i] = current
    return ranges


def _log_intensities(
    channels: Sequence[Events], t_us: Int64[Tensor, " t"], decay: Decay
) -> Float64[np.ndarray, "t c h w"]:
    return np.stack([_log_intensity_frames(events, t_us, decay) for events in channels], axis=1)


def _log_intensity_frames(events: Events, t_us: Int64[Tensor, " t"], decay: Decay) -> Float64[np.ndarray, "t h w"]:
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


def _shown(
    intensity: Float64[np.ndarray, "t c h w"], t_us: Int64[Tensor, " t"], intensity_range: Sequence[float], rule: str
) -> Float64[Tensor, "t c h w"]:
    low, high = np.array(intensity_range)[:, None, None] + np.zeros(intensity.shape[:2])
    if rule != "fixed":
        over = (-3, -2, -1) if rule == "common" else (-2, -1)
        darkest, brightest = np.quantile(intensity, ROBUST, axis=over).reshape(2, len(t_us), -1)
        low, high = following_ranges(darkest, brightest, t_us, intensity_range)
    span = np.maximum(high - low, np.finfo(np.float64).tiny)  # an image of one value has none in the end
    shown = (intensity - low[..., None, None]) / span[..., None, None]
    return torch.from_numpy(shown.clip(0, 1))


def _check_intensity_range(intensity_range: Sequence[float]) -> None:
    if len(intensity_range) != 2 or not intensity_range[0] < intensity_range[1]:
        raise ValueError(f"intensity_range: expected [low, high] with low < high, got {intensity_range}")
