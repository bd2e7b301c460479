"""A pixel with v2e's physics in continuous time: each event at its own threshold crossing.

Between frames the filtered log intensity is linear in time. Leak, refractory period and shot noise know nothing of
frames: the leak of a pixel has a random phase at the start and a new rate after every event; an event that falls into
the refractory period waits for its end and fires there if the change still exceeds the threshold; shot noise is a
Poisson process of each pixel. As the frame rate grows, v2e's signal events approach these.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import compiled, inlined
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.columns import LEAK, SHOT, SIGNAL
from polarnet.simulation.pixels.light import intensity_rows, linlog
from polarnet.simulation.pixels.pending import event_of, pending_events, place_of, roomier, write_in_order
from polarnet.simulation.pixels.randomness import key_for, mixed, rough_normal, uniform
from polarnet.simulation.pixels.strips import SPARE, flag_words, flagged, flags_of, rows_of_strip
from polarnet.simulation.pixels.v2e import (
    DARK_OFFSET,
    SATURATION,
    SHOT_NOISE_SLOPE,
    Physics,
    leak_factor_map,
    threshold_map,
)

SHOT_NOISE_IN_THE_DARK = 1 - SHOT_NOISE_SLOPE * DARK_OFFSET / SATURATION
SMALLEST_LAG = np.float32(1e-12)  # below, it is 0: processors are slow with the tiny numbers that decay leads to
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
    next_shot_us: np.ndarray


class Course(NamedTuple):
    """Pixels of a strip that are being followed through a step."""

    pixel: np.ndarray
    """int32, number in the strip"""
    groups: np.ndarray
    """int32, scratch"""
    place: np.ndarray
    """int64, see `pending`"""
    change: np.ndarray
    """float64, at time `now`"""
    now: np.ndarray
    """float64, microseconds since the start of the step"""


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
        next_shot_us=np.full(n, np.inf),
    )


@compiled
def start(light, pixels, physics, h, w, time_us, key, plane):
    """The first frame: nothing fires, and what has leaked since each pixel's last event is anyone's guess."""
    intensity_rows(light, 0, 0, w, pixels.dn)
    linlog(pixels.dn, pixels.linlog)
    phase_key, jitter_key = key_for(key, randomness.LEAK_PHASE, plane), key_for(key, randomness.LEAK_JITTER, plane)
    shot_key = key_for(key, randomness.SHOT_NOISE, plane)
    for i in range(h * w):
        if physics.leak_rate_hz > 0:
            pixels.leak[i] = jittered_leak(pixels.leak_nominal[i], physics.leak_jitter, jitter_key, i, time_us)
            pixels.change[i] = uniform(mixed(phase_key, i)) * pixels.threshold_on[i]
            if pixels.leak[i] > 0:
                pixels.last_event_us[i] = time_us - pixels.change[i] / pixels.leak[i]
        if physics.shot_noise_rate_hz > 0:
            threshold_on, threshold_off = pixels.threshold_on[i], pixels.threshold_off[i]
            pixels.next_shot_us[i] = time_us + _until_next_shot(
                physics, shot_key, i, time_us, threshold_on, threshold_off
            )


@compiled
def advance(light, offset, pixels, physics, h, w, times_us, step, key, plane, columns):
    """Run steps times_us[k] .. times_us[k + 1] under light[offset + k]; the columns and how many events they hold."""
    rows = rows_of_strip(h, w)
    strip = np.empty((4, rows * w), np.float32)
    m = rows * w + SPARE
    words = flag_words(rows * w)
    course = Course(np.empty(m, np.int32), np.empty(m, np.int32), np.empty(m, np.int64), np.empty(m), np.empty(m))
    keys = key_for(key, randomness.LEAK_JITTER, plane), key_for(key, randomness.SHOT_NOISE, plane)
    pending = pending_events(h * w, columns.exact_us.size > 0)
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
                _filter(
                    dn, response, pixels.dn[first:stop], pixels.linlog[first:stop], pixels.lag[first:stop], rate, rise
                )
            else:
                _difference(response, pixels.linlog[first:stop], rise)
            change, leak = pixels.change[first:stop], pixels.leak[first:stop]
            threshold_on, threshold_off = pixels.threshold_on[first:stop], pixels.threshold_off[first:stop]
            fires = flags_of(words, stop - first)
            _move(change, leak, rise, np.float32(stop_us - start_us), before, threshold_on, threshold_off, fires)
            shooting = soonest_us[y // rows] < stop_us
            if shooting:
                _flag_shots(pixels.next_shot_us[first:stop], stop_us, fires)
            active = _line_up(words, y, w, before, course)
            pending, n = _fire(
                pixels, physics, keys, course, active, rise, dn, first, shooting, start_us, stop_us, pending, n
            )
            if shooting:
                soonest_us[y // rows] = pixels.next_shot_us[first:stop].min()
        base_us = math.floor(start_us)
        columns, used = write_in_order(
            pending, n, np.int64(base_us), np.int64(math.ceil(stop_us) - base_us), columns, used
        )
    return columns, used


@compiled
def _difference(response, response_before, rise):
    for j in range(rise.size):
        rise[j] = response[j] - response_before[j]
        response_before[j] = response[j]


@compiled
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
        lag_after = lag_after if abs(lag_after) > SMALLEST_LAG else np.float32(0)
        rise[j] = step + (lag_after - lag[j])
        lag[j], dn_before[j], response_before[j] = lag_after, dn[j], response[j]


@compiled
def _move(change, leak, rise, dt_us, before, threshold_on, threshold_off, fires):
    """Advance each change by its rise and leak as if nothing fired; flag pixels beyond a threshold at either end."""
    for j in range(rise.size):
        start = change[j]
        stop = start + (rise[j] + leak[j] * dt_us)
        fires[j] = (max(start, stop) >= threshold_on[j]) | (min(start, stop) <= -threshold_off[j])
        before[j], change[j] = start, stop


@compiled
def _flag_shots(next_shot_us, stop_us, fires):
    for j in range(fires.size):
        fires[j] |= next_shot_us[j] < stop_us


@compiled
def _line_up(words, y, w, before, course):
    """Put the flagged pixels of a strip that begins at row y on the course; how many they are."""
    active, row_start = flagged(words, before.size, course.pixel, course.groups), 0
    for a in range(active):
        j = course.pixel[a]
        while j >= row_start + w:
            y, row_start = y + 1, row_start + w
        course.place[a], course.change[a], course.now[a] = place_of(y, j - row_start), before[np.uint64(j)], 0.0
    return active


@compiled
def _fire(pixels, physics, keys, course, active, rise, dn, first, shooting, start_us, stop_us, pending, n):
    """Follow the pixels on `course` through a step, in rounds: in each, a pixel fires once at most.

    Rounds instead of pixels, and choices instead of branches, because what a pixel does next is not to be guessed.
    Times are in microseconds since the start of the step. Returns the pending events and their number.
    """
    base_us, dt, shot = math.floor(start_us), stop_us - start_us, np.inf
    refractory_us, per_us = physics.refractory_s * 1e6, 1 / dt
    jitter = physics.leak_jitter if physics.leak_rate_hz > 0 else 0.0
    while active > 0:
        while n + active > pending.events.size:
            pending = roomier(pending)
        remaining = 0
        for a in range(active):
            j, place, change, now = course.pixel[a], course.place[a], course.change[a], course.now[a]
            i, at = np.uint64(first + j), np.uint64(n)  # unsigned: numba checks other indices for being negative
            j = np.uint64(j)
            last_us = pixels.last_event_us[i]
            last, leak, next_leak = last_us - start_us, np.float64(pixels.leak[i]), 0.0
            if jitter > 0:  # drawn before the event's own time is known, so that the two need not wait for each other
                next_leak = np.float64(jittered_leak(pixels.leak_nominal[i], jitter, keys[0], i, last_us))
            threshold_on, threshold_off = np.float64(pixels.threshold_on[i]), np.float64(pixels.threshold_off[i])
            slope = rise[j] * per_us + leak
            ready = max(now, last + refractory_us)
            at_ready = change + slope * (ready - now)
            on = (at_ready >= threshold_on) | ((at_ready > -threshold_off) & (slope > 0))
            excess = at_ready - threshold_on if on else -threshold_off - at_ready
            event = ready + (0.0 if excess >= 0 else abs(excess / slope))
            fires, again = event < dt, False
            label = LEAK if on & (leak * (event - last) > 0.5 * threshold_on) else SIGNAL
            if shooting:
                shot = pixels.next_shot_us[i] - start_us
                if shot < min(event, dt):
                    happens, on = _shot(physics, keys[1], i, start_us + shot, threshold_on, threshold_off, dn[j])
                    wait = _until_next_shot(physics, keys[1], i, start_us + shot, threshold_on, threshold_off)
                    pixels.next_shot_us[i] += wait
                    event, label, excess = shot, SHOT, 0.0
                    fires = happens & (event >= last + refractory_us)
                again = pixels.next_shot_us[i] < stop_us
            pending.events[at] = event_of(np.int64(start_us - base_us + event), place, on, label)
            if pending.exact_us.size:
                pending.exact_us[at] = start_us + event
            n += fires
            # a crossing leaves nothing of the change; after waiting, what exceeded the threshold remains
            rest = max(excess, 0.0) if on else -max(excess, 0.0)
            change, now, last = (rest, event, event) if fires else (change, now, last)
            if jitter > 0:
                leak = next_leak if fires else leak
            at_end = change + (rise[j] * per_us + leak) * (dt - now)
            pixels.change[i], pixels.leak[i], pixels.last_event_us[i] = at_end, leak, start_us + last
            kept = np.uint64(remaining)
            course.pixel[kept], course.place[kept] = j, place
            course.change[kept], course.now[kept] = change, now
            beyond = (max(change, at_end) >= threshold_on) | (min(change, at_end) <= -threshold_off)
            remaining += again | (fires & beyond)
        active = remaining
    return pending, n


@inlined
def _bits(key, i, time_us):
    """Random bits of what pixel i draws at a time."""
    return mixed(key ^ np.uint64(np.float64(time_us).view(np.int64)), i)


@compiled
def jittered_leak(nominal, jitter, key, i, time_us):
    """A leak of pixel i, drawn by a time: that of the event before the one that it follows."""
    return nominal * np.float32(max(1 - jitter * rough_normal(_bits(key, i, time_us)), 0.0))


@compiled
def _until_next_shot(physics, key, i, time_us, threshold_on, threshold_off):
    """Microseconds to the next event of a Poisson process with the rate that the pixel has in the dark."""
    share = physics.threshold_on / threshold_on + physics.threshold_off / threshold_off
    rate_hz = physics.shot_noise_rate_hz / 2 * SHOT_NOISE_IN_THE_DARK * share
    return -1e6 * math.log(uniform(_bits(key, i, time_us))) / rate_hz


@compiled
def _shot(physics, key, i, time_us, threshold_on, threshold_off, dn):
    """Whether the shot event that is due happens at this light, and whether it is ON."""
    on, off = physics.threshold_on / threshold_on, physics.threshold_off / threshold_off
    chance = (1 - SHOT_NOISE_SLOPE * (np.float64(dn) + DARK_OFFSET) / SATURATION) / SHOT_NOISE_IN_THE_DARK
    u = uniform(_bits(~key, i, time_us))
    return u < chance, u < chance * on / (on + off)
