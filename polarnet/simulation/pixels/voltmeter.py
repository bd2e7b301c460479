"""The pixel of DVS-Voltmeter (Lin et al., ECCV 2022): its voltage is a Brownian motion with drift between thresholds.

All constants are the paper's, in microseconds and thresholds: an event fires when the voltage has moved by 1. Signal
and noise are one process, so that events bear no label but SIGNAL.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import compiled
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.columns import SIGNAL
from polarnet.simulation.pixels.light import intensity_rows
from polarnet.simulation.pixels.pending import event_of, pending_events, place_of, roomier, write_in_order
from polarnet.simulation.pixels.randomness import key_for, mixed, normal, uniform

DRAWS = 3  # random numbers for a passage


class Physics(NamedTuple):
    """k1 to k6 of the paper's Eq. 10, fitted to one camera."""

    k1: float
    """drift per relative change of light"""
    k2: float
    """DN, dark offset"""
    k3: float
    """photon noise"""
    k4: float
    """leak in the dark, per microsecond"""
    k5: float
    """leak per DN"""
    k6: float
    """noise that does not depend on light"""


CAMERAS = {
    "dvs346": Physics(5.265, 20.0, 1e-4, 1e-7, 5e-9, 1e-5),
    "dvs240": Physics(4.424, 23.0, 2e-4, 1e-7, 5e-8, 1e-5),
}


class Pixels(NamedTuple):
    """State of one plane, one array per quantity, [h * w]."""

    dn: np.ndarray
    """float32, light of the last frame"""
    voltage: np.ndarray
    """float64, in thresholds since the last event"""


def initial(h: int, w: int, physics: Physics, key: np.uint64, plane: int) -> Pixels:
    """Pixels before their first frame."""
    return Pixels(np.zeros(h * w, np.float32), np.zeros(h * w))


@compiled
def start(light, pixels, physics, h, w, time_us, key, plane):
    """The first frame is what the pixels have adapted to."""
    intensity_rows(light, 0, 0, w, pixels.dn)


@compiled
def advance(light, offset, pixels, physics, h, w, times_us, step, key, plane, columns):
    """Run steps times_us[k] .. times_us[k + 1] under light[offset + k]; the columns and how many events they hold."""
    passage_key, used, dn = key_for(key, randomness.FIRST_PASSAGE, plane), 0, np.empty(w, np.float32)
    pending = pending_events(h * w, columns.exact_us.size > 0)
    for k in range(times_us.size - 1):
        n, step_key = 0, mixed(passage_key, step + k)
        for y in range(h):
            intensity_rows(light, offset + k, y, w, dn)
            pending, n = _walk(pixels, physics, step_key, y, dn, times_us[k], times_us[k + 1], pending, n)
        base_us = math.floor(times_us[k])
        longest_us = np.int64(math.ceil(times_us[k + 1]) - base_us)
        columns, used = write_in_order(pending, n, np.int64(base_us), longest_us, columns, used)
    return columns, used


@compiled
def _walk(pixels, physics, step_key, y, dn, start_us, stop_us, pending, n):
    """Let the voltages of row y pass from threshold to threshold through a step."""
    dt, base_us = stop_us - start_us, math.floor(start_us)
    for x in range(dn.size):
        i = y * dn.size + x
        before, after = np.float64(pixels.dn[i]), np.float64(dn[x])
        mean = (before + after) / 2
        drift = physics.k1 * (after - before) / dt / (mean + physics.k2) + physics.k4 + physics.k5 * mean
        noise = physics.k3 * math.sqrt(mean) / (mean + physics.k2) + physics.k6
        pixel_key, draw, now, voltage, place = mixed(step_key, i), 0, 0.0, pixels.voltage[i], place_of(y, x)
        while True:
            on = uniform(mixed(pixel_key, draw)) < chance_of_on(drift, noise, 1 - voltage, 1 + voltage)
            distance = 1 - voltage if on else 1 + voltage
            wait = first_passage(
                distance, drift if on else -drift, noise, mixed(pixel_key, draw + 1), mixed(pixel_key, draw + 2)
            )
            draw += DRAWS
            if not now + wait < dt:
                break
            now, voltage = now + wait, 0.0
            if n == pending.events.size:
                pending = roomier(pending)
            pending.events[n] = event_of(np.int64(start_us - base_us + now), place, on, SIGNAL)
            if pending.exact_us.size:
                pending.exact_us[n] = start_us + now
            n += 1
        pixels.voltage[i] = voltage + (distance if on else -distance) * (dt - now) / wait
        pixels.dn[i] = dn[x]
    return pending, n


@compiled
def chance_of_on(drift, noise, above, below):
    """Probability that a voltage `above` under the ON and `below` over the OFF threshold meets the ON one first."""
    if drift == 0:
        return 0.5
    scale = 2 * drift / (noise * noise)
    chance = (math.exp(scale * below) - 1) / (math.exp(scale * below) - math.exp(-scale * above))
    return 1.0 if math.isnan(chance) else chance


@compiled
def first_passage(distance, drift, noise, bits_1, bits_2):
    """Time in which a Brownian motion covers a distance: inverse Gaussian, by Michael, Schucany and Haas (1976).

    Against the drift it is conditional on arriving at all; the normal number then has to lie in its lower tail.
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
