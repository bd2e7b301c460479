"""The ideal pixel of ESIM (Rebecq et al., CoRL 2018), whose log intensity is linear in time between frames.

Its code comes in two forms, which differ where levels are met exactly: the one for the processor (`gpu` false) looks
for levels between the values of two frames, the one for the graphics card between its reference and the new value.
Both keep log intensity and reference in float32. There is no noise, mismatch or low-pass in this model.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import compiled
from polarnet.simulation.pixels.columns import SIGNAL
from polarnet.simulation.pixels.light import BYTES, FULL_SCALE, intensity_rows, ln
from polarnet.simulation.pixels.pending import event_of, pending_events, place_of, roomier, write_in_order
from polarnet.simulation.pixels.strips import rows_of_strip

NO_CHANGE = 1e-6  # log intensity: the form for the processor takes less for a pixel at rest
NEARLY = np.float32(0.99999)  # narrows a first look at thresholds by more than rounding


class Pixels(NamedTuple):
    """State of one plane, one array per quantity, [h * w]."""

    reference: np.ndarray
    """float32, the last level met"""
    logarithm: np.ndarray
    """float32, log intensity of the last frame"""
    last_event_us: np.ndarray
    """float64"""


class Physics(NamedTuple):
    """What the pixels of a sensor have in common."""

    threshold_on: float
    threshold_off: float
    refractory_us: float
    log_eps: float
    """added to intensity in [0, 1] before its logarithm is taken"""
    gpu: bool


def initial(h: int, w: int, physics: Physics, key: np.uint64, plane: int) -> Pixels:
    """Pixels before their first frame."""
    return Pixels(np.zeros(h * w, np.float32), np.zeros(h * w, np.float32), np.full(h * w, -np.inf))


@compiled
def _table(physics):
    """Log intensity of DN 0 ... 255, as the float32 closest to it."""
    table = np.empty(256, np.float32)
    for dn in range(256):
        table[dn] = math.log(
            np.float64(np.float32(np.float32(dn) / np.float32(FULL_SCALE)) + np.float32(physics.log_eps))
        )
    return table


@compiled
def _respond(light, k, y, w, physics, table, dn, logarithm):
    intensity_rows(light, k, y, w, dn)
    if light.kind == BYTES:
        for j in range(dn.size):
            logarithm[j] = table[np.int32(dn[j])]
    else:
        for j in range(dn.size):
            logarithm[j] = ln(dn[j] / np.float32(FULL_SCALE) + np.float32(physics.log_eps))


@compiled
def start(light, pixels, physics, h, w, time_us, key, plane):
    """The first frame sets the reference."""
    _respond(light, 0, 0, w, physics, _table(physics), np.empty(h * w, np.float32), pixels.logarithm)
    pixels.reference[:] = pixels.logarithm


@compiled
def advance(light, offset, pixels, physics, h, w, times_us, step, key, plane, columns):
    """Run steps times_us[k] .. times_us[k + 1] under light[offset + k]; the columns and how many events they hold."""
    rows, table, used = rows_of_strip(h, w), _table(physics), 0
    strip = np.empty((2, rows * w), np.float32)
    pending = pending_events(h * w, columns.exact_us.size > 0)
    for k in range(times_us.size - 1):
        n = 0
        for y in range(0, h, rows):
            first, stop = y * w, min(y + rows, h) * w
            dn, logarithm = strip[0, : stop - first], strip[1, : stop - first]
            _respond(light, offset + k, y, w, physics, table, dn, logarithm)
            for r in range(y, min(y + rows, h)):
                here = slice((r - y) * w, (r - y + 1) * w)
                pending, n = _fire(pixels, physics, r, logarithm[here], times_us[k], times_us[k + 1], pending, n)
            pixels.logarithm[first:stop] = logarithm
        base_us = math.floor(times_us[k])
        longest_us = np.int64(math.ceil(times_us[k + 1]) - base_us)
        columns, used = write_in_order(pending, n, np.int64(base_us), longest_us, columns, used)
    return columns, used


@compiled
def _fire(pixels, physics, y, logarithm, start_us, stop_us, pending, n):
    """Events of row y between two frames."""
    w, dt, base_us = logarithm.size, stop_us - start_us, math.floor(start_us)
    for x in range(w):
        i = y * w + x
        before, after, reference = pixels.logarithm[i], logarithm[x], pixels.reference[i]
        on = after > reference if physics.gpu else after >= before
        sign = np.float32(1 if on else -1)
        threshold = np.float32(physics.threshold_on if on else physics.threshold_off)
        if (after - reference) * sign < threshold * NEARLY:
            continue
        crossed = _levels(physics, before, after, reference, sign, threshold)
        while n + crossed > pending.events.size:
            pending = roomier(pending)
        place, level = place_of(y, x), reference
        for _ in range(crossed):
            level += sign * threshold
            event_us = start_us + dt * _share(before, after, level)
            if physics.gpu:
                event_us = np.floor(event_us * 1e3) * 1e-3  # it counts whole nanoseconds
            waited = event_us - pixels.last_event_us[i]
            if waited > physics.refractory_us or (waited == physics.refractory_us and not physics.gpu):
                offset_us = min(np.int64(event_us), np.int64(math.ceil(stop_us)) - 1) - base_us
                pending.events[n] = event_of(offset_us, place, on, SIGNAL)
                if pending.exact_us.size:
                    pending.exact_us[n] = event_us
                pixels.last_event_us[i] = event_us
                n += 1
        if physics.gpu:  # which computes the new reference in one fused operation
            level = np.float32(np.float64(reference) + np.float64(sign * threshold) * crossed)
        pixels.reference[i] = level
    return pending, n


@compiled
def _levels(physics, before, after, reference, sign, threshold):
    """How many levels are crossed."""
    if physics.gpu:
        return int(abs(after - reference) / threshold)
    crossed, level = 0, reference + sign * threshold
    if abs(np.float64(after) - np.float64(before)) > NO_CHANGE:
        while level * sign > before * sign and level * sign <= after * sign:
            crossed, level = crossed + 1, level + sign * threshold
    return crossed


@compiled
def _share(before, after, level):
    """Of the time between two frames after which a level is met; at once where rounding left it behind at rest."""
    return (
        (np.float64(level) - np.float64(before)) / (np.float64(after) - np.float64(before)) if after != before else 0.0
    )
