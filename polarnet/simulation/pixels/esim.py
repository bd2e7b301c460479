"""The pixel model `esim` (Rebecq et al., CoRL 2018): log intensity is linear in time between frames.

As in the published code for a CPU, log intensity and reference are float32, and levels are looked for between the
values of two frames. The model has no noise, mismatch or low-pass.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.runtime.compilation import ZERO, compiled
from polarnet.simulation.pixels.columns import event_of, place_of, roomier, write_in_order
from polarnet.simulation.pixels.light import FULL_SCALE, intensity_rows, ln
from polarnet.simulation.pixels.physics import PixelConfig

EIGHT_BIT_VIDEO = False
OPTIONS: tuple[str, ...] = ()
NO_CHANGE = 1e-6  # log intensity; smaller changes are ignored
NEARLY = np.float32(0.99999)  # lowers thresholds by more than rounding in a first test


class Physics(NamedTuple):
    """`PixelConfig` for compiled kernels."""

    threshold_on: float
    threshold_off: float
    refractory_us: float
    log_eps: float


class Pixels(NamedTuple):
    """State of one channel, one array [h * w] per quantity."""

    reference: np.ndarray  # float32, log intensity of the last level crossed
    logarithm: np.ndarray  # float32, log intensity of the last frame
    last_event_us: np.ndarray  # float64


def physics_of(config: PixelConfig) -> Physics:
    """The parameters for the kernels."""
    on, off = config.contrast_threshold_on, config.contrast_threshold_off
    return Physics(on, off, config.refractory_period_us, config.esim_log_eps)


def initial(height: int, width: int, physics: Physics, key: np.uint64, channel: int) -> Pixels:
    """State of the pixels before the first frame: zeros, and no event yet."""
    n = height * width
    return Pixels(np.zeros(n, np.float32), np.zeros(n, np.float32), np.full(n, -np.inf))


@compiled
def _table(physics):
    """Log intensity of 0 to 255 DN, rounded to float32."""
    table = np.empty(256, np.float32)
    for dn in range(256):
        fraction = np.float32(np.float32(dn) / np.float32(FULL_SCALE))
        table[dn] = math.log(np.float64(fraction + np.float32(physics.log_eps)))
    return table


@compiled
def _respond(light, frame, steps, y, table, dn, logarithm):
    intensity_rows(light, frame, y, steps.width, dn)
    if light.images.itemsize == 1:
        for j in range(dn.size):
            logarithm[j] = table[np.int32(dn[j])]
    else:
        for j in range(dn.size):
            logarithm[j] = ln(dn[j] / np.float32(FULL_SCALE) + np.float32(steps.physics.log_eps))


@compiled
def start(light, pixels, steps):
    """Set the reference to the first frame; nothing fires."""
    dn, table = np.empty(pixels.logarithm.size, np.float32), _table(steps.physics)
    _respond(light, ZERO, steps, ZERO, table, dn, pixels.logarithm)
    pixels.reference[:] = pixels.logarithm


@compiled
def advance(light, pixels, steps, columns):
    """Advance the pixels through `steps`, in place; return the columns with the events, and the number of events."""
    w, table, used = steps.width, _table(steps.physics), ZERO
    dn, logarithm = np.empty((2, w), np.float32)
    pending = np.empty(steps.height * w, np.int64)
    for k in range(steps.times_us.size - 1):
        n = ZERO
        for y in range(steps.height):
            _respond(light, steps.first_frame + k, steps, y, table, dn, logarithm)
            pending, n = _fire(pixels, steps, k, y, logarithm, pending, n)
            pixels.logarithm[y * w : (y + 1) * w] = logarithm
        columns, used = write_in_order(steps, k, pending, n, columns, used)
    return columns, used


@compiled
def _fire(pixels, steps, k, y, logarithm, pending, n):
    """Append the events of row y in step k to the n pending ones; returns both."""
    physics, start_us, stop_us = steps.physics, steps.times_us[k], steps.times_us[k + 1]
    w, dt, base_us = logarithm.size, stop_us - start_us, math.floor(start_us)
    for x in range(w):
        i = y * w + x
        before, after, reference = pixels.logarithm[i], logarithm[x], pixels.reference[i]
        change, on = np.float64(after) - np.float64(before), after >= before
        sign = np.float32(1 if on else -1)
        threshold = np.float32(physics.threshold_on if on else physics.threshold_off)
        if (after - reference) * sign < threshold * NEARLY or abs(change) <= NO_CHANGE:
            continue
        place, level = place_of(y, x), reference + sign * threshold
        while level * sign > before * sign and level * sign <= after * sign:
            pixels.reference[i] = level
            event_us = start_us + dt * ((np.float64(level) - np.float64(before)) / change)
            if event_us - pixels.last_event_us[i] >= physics.refractory_us:
                if n == pending.size:
                    pending = roomier(pending)
                offset_us = min(np.int64(event_us), np.int64(math.ceil(stop_us)) - 1) - base_us
                pending[n] = event_of(offset_us, place, on)
                pixels.last_event_us[i] = event_us
                n += 1
            level += sign * threshold
    return pending, n
