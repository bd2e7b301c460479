"""The pixel model `dvs_voltmeter` (Lin et al., ECCV 2022): a voltage in Brownian motion with drift between thresholds.

All constants are the paper's, in microseconds and thresholds: an event fires when the voltage has moved by 1. They are
fitted to a DVS346, whatever the configured parameters.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.runtime.compilation import ZERO, compiled
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.columns import Steps, event_of, pixel_place, roomier, write_in_order
from polarnet.simulation.pixels.light import Light, intensity_rows
from polarnet.simulation.pixels.randomness import key_for, mixed, normal, uniform

EIGHT_BIT_VIDEO = False
DRAWS = 3  # random numbers for the way from one event to the next


class Constants(NamedTuple):
    """k1 to k6 of the paper's Eq. 10, fitted to one camera."""

    k1: float  # drift per relative change of light
    k2: float  # dark offset, DN
    k3: float  # photon noise
    k4: float  # leak in the dark, per microsecond
    k5: float  # leak per DN
    k6: float  # noise that does not depend on light


DVS346 = Constants(5.265, 20.0, 1e-4, 1e-7, 5e-9, 1e-5)


class Pixels(NamedTuple):
    """State of one channel, one array [h * w] per quantity."""

    dn: np.ndarray  # float32, light of the last frame, DN
    voltage: np.ndarray  # float64, change since the last event, in thresholds


def start(light: Light, steps: Steps) -> Pixels:
    """Pixels adapted to the first frame, with voltage 0."""
    n = steps.height * steps.width
    pixels = Pixels(np.empty(n, np.float32), np.zeros(n))
    intensity_rows(light, ZERO, ZERO, steps.width, pixels.dn)
    return pixels


@compiled
def advance(light, pixels, steps, columns):
    """Advance the pixels through `steps`, in place; return the columns with the events, and the number of events."""
    dn, pending, used = np.empty_like(pixels.dn), np.empty(pixels.dn.size, np.int64), ZERO
    for k in range(steps.times_us.size - 1):
        intensity_rows(light, steps.first_frame + k, ZERO, steps.width, dn)
        pending, n = _walk(pixels, steps, k, dn, pending)
        columns, used = write_in_order(steps, k, pending, n, columns, used)
    return columns, used


@compiled
def _walk(pixels, steps, k, dn, pending):
    """Move the voltages from threshold to threshold through step k; return the pending events and their number."""
    k1, k2, k3, k4, k5, k6 = DVS346
    start_us, dt = steps.times_us[k], steps.times_us[k + 1] - steps.times_us[k]
    base_us, n = math.floor(start_us), ZERO
    key = mixed(key_for(steps.key, randomness.FIRST_PASSAGE, steps.channel), steps.first_number + k)
    for i in range(dn.size):
        before, after = np.float64(pixels.dn[i]), np.float64(dn[i])
        mean = (before + after) / 2
        drift = k1 * (after - before) / dt / (mean + k2) + k4 + k5 * mean
        noise = k3 * math.sqrt(mean) / (mean + k2) + k6
        pixel_key, draw, now, voltage = mixed(key, i), 0, 0.0, pixels.voltage[i]
        while True:
            on = uniform(mixed(pixel_key, draw)) < chance_of_on(drift, noise, 1 - voltage, 1 + voltage)
            distance = 1 - voltage if on else 1 + voltage
            along = drift if on else -drift
            wait = first_passage(distance, along, noise, mixed(pixel_key, draw + 1), mixed(pixel_key, draw + 2))
            draw += DRAWS
            if not now + wait < dt:
                break
            now, voltage = now + wait, 0.0
            if n == pending.size:
                pending = roomier(pending)
            pending[n] = event_of(np.int64(start_us - base_us + now), pixel_place(i, steps.width), on)
            n += 1
        pixels.voltage[i] = voltage + (distance if on else -distance) * (dt - now) / wait
        pixels.dn[i] = dn[i]
    return pending, n


@compiled
def chance_of_on(drift, noise, above, below):
    """Probability that the ON threshold, `above` the voltage, is met before the OFF threshold, `below` it."""
    if drift == 0:
        return 0.5
    scale = 2 * drift / (noise * noise)
    chance = (math.exp(scale * below) - 1) / (math.exp(scale * below) - math.exp(-scale * above))
    return 1.0 if math.isnan(chance) else chance


@compiled
def first_passage(distance, drift, noise, bits_1, bits_2):
    """Time until a Brownian motion has covered a distance: inverse Gaussian, by Michael, Schucany and Haas (1976).

    Against the drift, the time is conditional on arrival; the normal number then lies in its lower tail.
    """
    shape, u = (distance / noise) ** 2, uniform(bits_1)
    if drift == 0:
        return shape / normal(u) ** 2
    mean = distance / drift
    if drift < 0:
        u *= normal_cdf(-math.sqrt(-4 * distance * drift) / noise)
    y = normal(u) ** 2
    root = math.sqrt(max(4 * mean * shape * y + mean * mean * y * y, 0.0))
    time = mean + mean * mean * y / (2 * shape) - mean / (2 * shape) * root
    return time if uniform(bits_2) <= mean / (mean + time) else mean * mean / time


@compiled
def normal_cdf(x):
    """The standard normal distribution function."""
    return 0.5 * math.erfc(-x / math.sqrt(2))
