"""A pixel with v2e's physics in continuous time: each event at its own threshold crossing.

Between frames the filtered log intensity is linear in time. Leak, refractory period and shot noise know nothing of
frames: the leak of a pixel has a random phase at the start and a new rate after every event; an event that falls into
the refractory period waits for its end and fires there if the change still exceeds the threshold; shot noise is a
Poisson process of each pixel. As the frame rate grows, v2e's signal events approach these.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.columns import LEAK, SHOT, SIGNAL
from polarnet.simulation.pixels.light import intensity_rows, linlog
from polarnet.simulation.pixels.pending import kind_of, pending_events, roomier, write_in_order
from polarnet.simulation.pixels.randomness import key_for, mixed, rough_normal, uniform
from polarnet.simulation.pixels.v2e import (
    DARK_OFFSET,
    SATURATION,
    SHOT_NOISE_SLOPE,
    STRIP,
    Physics,
    leak_factor_map,
    threshold_map,
)

SHOT_NOISE_IN_THE_DARK = 1 - SHOT_NOISE_SLOPE * DARK_OFFSET / SATURATION
LONG_AGO_US = -1e18
LOG2_E = np.float32(1 / math.log(2))
# 2^f - 1 on [-1/2, 1/2]: f times a polynomial (Taylor's to f^6, whose error is below 1e-7)
EXP2 = tuple(np.float32(math.log(2) ** k / math.factorial(k)) for k in range(1, 8))


class Pixels(NamedTuple):
    """State of one plane, one array per quantity, [h * w]."""

    change: np.ndarray
    """filtered log intensity since the last event, leak included"""
    dn: np.ndarray
    """light of the last frame"""
    linlog: np.ndarray
    """its log response"""
    lag: np.ndarray
    """how far the filtered response is above the response"""
    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak_nominal: np.ndarray
    """log intensity per microsecond, frozen per pixel"""
    leak: np.ndarray
    """the same with the jitter of the time since the last event"""
    last_event_us: np.ndarray
    events: np.ndarray
    """int64, fired so far: numbers the draws of the leak's jitter"""
    next_shot_us: np.ndarray
    shots: np.ndarray
    """int64, draws of shot noise so far"""


def initial(h: int, w: int, physics: Physics, key: np.uint64, plane: int) -> Pixels:
    """Pixels before their first frame, with this plane's own mismatch."""
    n, sigma = h * w, physics.threshold_sigma
    threshold_on = threshold_map(physics.threshold_on, sigma, n, key, randomness.THRESHOLD_ON, plane)
    leak_factor = leak_factor_map(physics.noise_rate_cov_decades, n, key, plane)
    zeros = np.zeros(n, np.float32)
    return Pixels(
        change=zeros,
        dn=zeros.copy(),
        linlog=zeros.copy(),
        lag=zeros.copy(),
        threshold_on=threshold_on,
        threshold_off=threshold_map(physics.threshold_off, sigma, n, key, randomness.THRESHOLD_OFF, plane),
        leak_nominal=np.float32(physics.leak_rate_hz * 1e-6) * leak_factor * threshold_on,
        leak=zeros.copy(),
        last_event_us=np.full(n, LONG_AGO_US),
        events=np.zeros(n, np.int64),
        next_shot_us=np.full(n, np.inf),
        shots=np.zeros(n, np.int64),
    )


@njit(nogil=True, cache=True)
def start(light, pixels, physics, h, w, time_us, key, plane):
    """The first frame: nothing fires, and what has leaked since each pixel's last event is anyone's guess."""
    intensity_rows(light, 0, 0, w, pixels.dn)
    linlog(pixels.dn, pixels.linlog)
    phase_key, jitter_key = key_for(key, randomness.LEAK_PHASE, plane), key_for(key, randomness.LEAK_JITTER, plane)
    shot_key = key_for(key, randomness.SHOT_NOISE, plane)
    for i in range(h * w):
        if physics.leak_rate_hz > 0:
            pixels.leak[i] = jittered_leak(pixels.leak_nominal[i], physics.leak_jitter, jitter_key, i, 0)
            pixels.change[i] = uniform(mixed(phase_key, i)) * pixels.threshold_on[i]
            if pixels.leak[i] > 0:
                pixels.last_event_us[i] = time_us - pixels.change[i] / pixels.leak[i]
        if physics.shot_noise_rate_hz > 0:
            threshold_on, threshold_off = pixels.threshold_on[i], pixels.threshold_off[i]
            pixels.next_shot_us[i] = time_us + _until_next_shot(physics, shot_key, i, 0, threshold_on, threshold_off)


@njit(nogil=True, cache=True)
def advance(light, offset, pixels, physics, h, w, times_us, step, key, plane, columns):
    """Run steps times_us[k] .. times_us[k + 1] under light[offset + k]; the columns and how many events they hold."""
    rows = min(h, 1 + STRIP // w)
    strip = np.empty((4, rows * w), np.float32)
    flags, candidates = np.empty(rows * w, np.uint8), np.empty(rows * w + 1, np.int32)
    keys = key_for(key, randomness.LEAK_JITTER, plane), key_for(key, randomness.SHOT_NOISE, plane)
    pending = pending_events(h * w)
    soonest_us = np.array([pixels.next_shot_us[y * w : (y + rows) * w].min() for y in range(0, h, rows)])
    used = 0
    for k in range(times_us.size - 1):
        start_us, stop_us = times_us[k], times_us[k + 1]
        n = 0
        for y in range(0, h, rows):
            first, stop = y * w, min(y + rows, h) * w
            dn, response = strip[0, : stop - first], strip[1, : stop - first]
            rise, before = strip[2, : stop - first], strip[3, : stop - first]
            intensity_rows(light, offset + k, y, w, dn)
            linlog(dn, response)
            if physics.cutoff_hz > 0:
                rate = np.float32(2e-6 * math.pi * physics.cutoff_hz * (stop_us - start_us) / SATURATION)
                _filter(dn, response, pixels.dn[first:stop], pixels.linlog[first:stop], pixels.lag[first:stop], rate, rise)
            else:
                _difference(response, pixels.linlog[first:stop], rise)
            fires = flags[: stop - first]
            _flag(pixels, first, rise, np.float32(stop_us - start_us), before, fires)
            strip_number = y // rows
            if soonest_us[strip_number] < stop_us:
                fires |= pixels.next_shot_us[first:stop] < stop_us
            found = 0
            for j in range(fires.size):  # without a branch, since which pixels fire is not to be guessed
                candidates[found] = j
                found += fires[j]
            c = 0
            while True:
                c, n = _fire(pixels, physics, keys, candidates[:found], c, y, w, before, rise, dn, start_us, stop_us, pending, n)
                if c == found:
                    break
                pending = roomier(pending)
            if soonest_us[strip_number] < stop_us:
                soonest_us[strip_number] = pixels.next_shot_us[first:stop].min()
        base_us = math.floor(start_us)
        columns, used = write_in_order(pending, n, np.int64(base_us), np.int64(math.ceil(stop_us) - base_us), columns, used)
    return columns, used


@njit(nogil=True, cache=True, error_model="numpy")
def _difference(response, response_before, rise):
    for j in range(rise.size):
        rise[j] = response[j] - response_before[j]
        response_before[j] = response[j]


@njit(nogil=True, cache=True, error_model="numpy")
def _filter(dn, response, dn_before, response_before, lag, rate, rise):
    """First-order low-pass of a response that is linear in time, with the bandwidth at the mean light of the step.

    Solved exactly over the step, so that the result does not hang on the frame rate: with a = bandwidth * dt,
    lag <- lag exp(-a) - (change of response) (1 - exp(-a)) / a.
    """
    c1, c2, c3, c4, c5, c6, c7 = EXP2
    for j in range(dn.size):
        a = min(rate * (np.float32(0.5) * (dn[j] + dn_before[j]) + np.float32(DARK_OFFSET)), np.float32(80))
        whole = np.rint(-a * LOG2_E)
        f = -a * LOG2_E - whole
        scale = np.float32(np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32))
        above_one = f * (c1 + f * (c2 + f * (c3 + f * (c4 + f * (c5 + f * (c6 + f * c7))))))
        decayed = (np.float32(1) - scale) - scale * above_one  # 1 - exp(-a), accurate for small a as well
        step = response[j] - response_before[j]
        lag_after = lag[j] - lag[j] * decayed - step * (decayed / a)
        rise[j] = step + (lag_after - lag[j])
        lag[j], dn_before[j], response_before[j] = lag_after, dn[j], response[j]


@njit(nogil=True, cache=True, error_model="numpy")
def _flag(pixels, first, rise, dt_us, before, fires):
    """Advance each change by its rise and leak as if nothing fired; flag pixels at or beyond a threshold."""
    stop = first + rise.size
    change, leak = pixels.change[first:stop], pixels.leak[first:stop]
    threshold_on, threshold_off = pixels.threshold_on[first:stop], pixels.threshold_off[first:stop]
    for j in range(rise.size):
        before[j] = change[j]
        after = change[j] + (rise[j] + leak[j] * dt_us)
        change[j] = after
        fires[j] = (max(before[j], after) >= threshold_on[j]) | (min(before[j], after) <= -threshold_off[j])


@njit(nogil=True, cache=True, error_model="numpy")
def _fire(pixels, physics, keys, candidates, c, y, w, before, rise, dn, start_us, stop_us, pending, n):
    """Follow the candidates of a strip, from number c on, through a step, each from event to event.

    Returns the number of the first candidate for which there was no room left, and the number of pending events.
    Times are in microseconds since the start of the step.
    """
    first, row_end, base_us, dt, room = y * w, w, math.floor(start_us), stop_us - start_us, pending.place.size
    refractory_us, jitter = physics.refractory_s * 1e6, physics.leak_jitter if physics.leak_rate_hz > 0 else 0.0
    while c < candidates.size:
        j = candidates[c]
        while j >= row_end:
            y, row_end = y + 1, row_end + w
        i, place, n_before = first + j, np.int32(y << 16 | (j - row_end + w)), n
        threshold_on, threshold_off = np.float64(pixels.threshold_on[i]), np.float64(pixels.threshold_off[i])
        change, slope, leak = np.float64(before[j]), np.float64(rise[j]) / dt, np.float64(pixels.leak[i])
        now, last, shot = 0.0, pixels.last_event_us[i] - start_us, pixels.next_shot_us[i] - start_us
        events, shots = pixels.events[i], pixels.shots[i]
        while n < room:
            ready = max(now, last + refractory_us)
            at_ready = change + (slope + leak) * (ready - now)
            rising = at_ready >= threshold_on or (at_ready > -threshold_off and slope + leak > 0)
            excess = at_ready - threshold_on if rising else -threshold_off - at_ready
            event = ready if excess >= 0 else ready + abs(excess / (slope + leak))
            label = SIGNAL
            if not min(event, shot) < dt:
                break
            if shot < event:
                rising, fires = _shot(physics, keys[1], i, shots, threshold_on, threshold_off, dn[j])
                event, label, shots = shot, SHOT, shots + 2
                shot += _until_next_shot(physics, keys[1], i, shots, threshold_on, threshold_off)
                if not fires or event < last + refractory_us:
                    continue
                change = 0.0
            else:
                if rising and leak * (event - last) > 0.5 * threshold_on:
                    label = LEAK
                # a crossing leaves nothing of the change; after waiting, what exceeded the threshold remains
                change = max(excess, 0.0) if rising else -max(excess, 0.0)
            pending.offset_us[n], pending.place[n] = np.int32(math.floor(start_us + event) - base_us), place
            pending.kind[n], pending.exact_us[n] = kind_of(1 if rising else -1, label), start_us + event
            n += 1
            now = last = event
            if jitter > 0:
                events += 1
                leak = np.float64(jittered_leak(pixels.leak_nominal[i], jitter, keys[0], i, events))
        else:
            return c, n_before
        pixels.change[i], pixels.leak[i] = change + (slope + leak) * (dt - now), leak
        pixels.last_event_us[i], pixels.events[i] = start_us + last, events
        if shots != pixels.shots[i]:
            pixels.next_shot_us[i], pixels.shots[i] = start_us + shot, shots
        c += 1
    return c, n


@njit(nogil=True, cache=True, error_model="numpy")
def jittered_leak(nominal, jitter, key, i, events):
    """The leak of pixel i between its event number `events` and the next."""
    return nominal * np.float32(max(1 - jitter * rough_normal(mixed(key, (i << 32) + events)), 0.0))


@njit(nogil=True, cache=True, error_model="numpy")
def _until_next_shot(physics, key, i, draw, threshold_on, threshold_off):
    """Microseconds to the next event of a Poisson process with the rate that the pixel has in the dark."""
    share = physics.threshold_on / threshold_on + physics.threshold_off / threshold_off
    rate_hz = physics.shot_noise_rate_hz / 2 * SHOT_NOISE_IN_THE_DARK * share
    return -1e6 * math.log(uniform(mixed(key, (i << 32) + draw))) / rate_hz


@njit(nogil=True, cache=True, error_model="numpy")
def _shot(physics, key, i, draw, threshold_on, threshold_off, dn):
    """Whether the shot event that is due is ON, and whether it happens at all at this light."""
    on, off = physics.threshold_on / threshold_on, physics.threshold_off / threshold_off
    chance = (1 - SHOT_NOISE_SLOPE * (np.float64(dn) + DARK_OFFSET) / SATURATION) / SHOT_NOISE_IN_THE_DARK
    u = uniform(mixed(key, (i << 32) + draw + 1))
    return u < chance * on / (on + off), u < chance
