"""Angle of a rotating polarizer over time."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, Shaped


@dataclass(frozen=True, eq=False)  # arrays have no single answer to ==
class Rotation:
    """Angle of the polarizer's axis at known times, interpolated linearly between them and extrapolated outside."""

    times_us: Float64[np.ndarray, " n"]
    """At least two, increasing."""
    angles: Float64[np.ndarray, " n"]
    """Radians, unwrapped: a full turn adds 2 pi."""

    def __post_init__(self):
        if self.times_us.shape != self.angles.shape or len(self.times_us) < 2:
            raise ValueError(f"rotation: expected at least two times with one angle each, got {self.times_us.shape}")
        if not (np.isfinite(self.times_us).all() and (np.diff(self.times_us) > 0).all()):
            raise ValueError(f"rotation: expected increasing times, got {self.times_us[:5].tolist()}... us")
        if self.rate_hz == 0:
            raise ValueError("rotation: expected a polarizer that turns, its first and last angles are equal")

    @property
    def rate_hz(self) -> float:
        """Mean turns per second; negative if the angle falls."""
        turns = (self.angles[-1] - self.angles[0]) / (2 * math.pi)
        return float(turns / (self.times_us[-1] - self.times_us[0]) * 1e6)

    @property
    def half_turn_us(self) -> float:
        """Duration of half a turn, over which the light behind the polarizer goes through one period."""
        return 0.5e6 / abs(self.rate_hz)

    def since(self, start_us: int) -> "Rotation":
        """The same rotation for times that count from `start_us`."""
        return Rotation(self.times_us - start_us, self.angles)

    def at(self, t_us: Shaped[np.ndarray, "*m"]) -> Float64[np.ndarray, "*m"]:
        """Angle in radians at times in microseconds."""
        t, known = np.asarray(t_us, np.float64), self.times_us
        k = np.clip(np.searchsorted(known, t, side="right") - 1, 0, len(known) - 2)
        slope = np.diff(self.angles) / np.diff(known)
        return self.angles[k] + slope[k] * (t - known[k])


def steady_rotation(rate_hz: float, start_angle: float = 0.0) -> Rotation:
    """Rotation at `rate_hz` turns per second from `start_angle` (radians) at time 0; ValueError for a rate of 0."""
    if not (math.isfinite(rate_hz) and rate_hz):
        raise ValueError(f"rotation: expected a rate in turns per second other than 0, got {rate_hz}")
    turn = math.copysign(2 * math.pi, rate_hz)
    return Rotation(np.array([0.0, 1e6 / abs(rate_hz)]), start_angle + np.array([0.0, turn]))


def triggered_rotation(
    trigger_us: Int64[np.ndarray, " n"], start_angle: float = 0.0, turns_per_trigger: float = 1.0
) -> Rotation:
    """Rotation from `start_angle` (radians) at the first trigger, by `turns_per_trigger` to each next trigger."""
    if len(trigger_us) < 2:
        raise ValueError(f"rotation: expected at least two trigger times, got {len(trigger_us)}; give the rate instead")
    turns = turns_per_trigger * np.arange(len(trigger_us))
    return Rotation(trigger_us.astype(np.float64), start_angle + 2 * math.pi * turns)
