"""The pixel model `esim` (Rebecq et al., CoRL 2018): log intensity is linear in time between frames.

As in the published code for a CPU, log intensity and reference are float32, and levels are looked for between the
values of two frames. The model has a refractory period, but no noise, mismatch or low-pass.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.runtime.compilation import ZERO, compiled
from polarnet.simulation.pixels.columns import Steps, event_of, pixel_place, roomier, write_in_order
from polarnet.simulation.pixels.light import FULL_SCALE, Light, intensity_rows, ln

EIGHT_BIT_VIDEO = False
NO_CHANGE = 1e-6  # log intensity; smaller changes are ignored
NEARLY = np.float32(0.99999)  # factor on thresholds in a quick first test, so that rounding hides no crossing


class Pixels(NamedTuple):
    """State of one channel, one array [h * w] per quantity."""

    reference: np.ndarray  # float32, log intensity of the last level crossed
    logarithm: np.ndarray  # float32, log intensity of the last frame
    last_event_us: np.ndarray  # float64


def start(light: Light, steps: Steps) -> Pixels:
    """Pixels whose reference is the log intensity of the first frame; nothing has fired."""
    n = steps.height * steps.width
    dn, logarithm = np.empty((2, n), np.float32)
    _respond(light, ZERO, steps, _table(steps.physics), dn, logarithm)
    return Pixels(logarithm.copy(), logarithm, np.full(n, -np.inf))


@compiled
def _table(physics):
    """Log intensity of 0 to 255 DN, rounded to float32."""
    table = np.empty(256, np.float32)
    for dn in range(256):
        fraction = np.float32(np.float32(dn) / np.float32(FULL_SCALE))
        table[dn] = math.log(np.float64(fraction + np.float32(physics.esim_log_eps)))
    return table


@compiled
def _respond(light, frame, steps, table, dn, logarithm):
    intensity_rows(light, frame, ZERO, steps.width, dn)
    if light.images.itemsize == 1:
        for j in range(dn.size):
            logarithm[j] = table[np.int32(dn[j])]
    else:
        for j in range(dn.size):
            logarithm[j] = ln(dn[j] / np.float32(FULL_SCALE) + np.float32(steps.physics.esim_log_eps))


@compiled
def advance(light, pixels, steps, columns):
    """Advance the pixels through `steps`, in place; return the columns with the events, and the number of events."""
    table, used = _table(steps.physics), ZERO
    dn, logarithm = np.empty((2, pixels.logarithm.size), np.float32)
    pending = np.empty(dn.size, np.int64)
    for k in range(steps.times_us.size - 1):
        _respond(light, steps.first_frame + k, steps, table, dn, logarithm)
        pending, n = _fire(pixels, steps, k, logarithm, pending)
        pixels.logarithm[:] = logarithm
        columns, used = write_in_order(steps, k, pending, n, columns, used)
    return columns, used


@compiled
def _fire(pixels, steps, k, logarithm, pending):
    """Pending events of step k, and their number."""
    physics, start_us, stop_us = steps.physics, steps.times_us[k], steps.times_us[k + 1]
    dt, base_us, n = stop_us - start_us, math.floor(start_us), ZERO
    for i in range(logarithm.size):
        before, after, reference = pixels.logarithm[i], logarithm[i], pixels.reference[i]
        change, on = np.float64(after) - np.float64(before), after >= before
        sign = np.float32(1 if on else -1)
        threshold = np.float32(physics.threshold_on if on else physics.threshold_off)
        if (after - reference) * sign < threshold * NEARLY or abs(change) <= NO_CHANGE:
            continue
        place, level = pixel_place(i, steps.width), reference + sign * threshold
        while level * sign > before * sign and level * sign <= after * sign:
            pixels.reference[i] = level
            event_us = start_us + dt * ((np.float64(level) - np.float64(before)) / change)
            if event_us - pixels.last_event_us[i] >= physics.refractory_period_us:
                if n == pending.size:
                    pending = roomier(pending)
                offset_us = min(np.int64(event_us), np.int64(math.ceil(stop_us)) - 1) - base_us
                pending[n] = event_of(offset_us, place, on)
                pixels.last_event_us[i] = event_us
                n += 1
            level += sign * threshold
    return pending, n
