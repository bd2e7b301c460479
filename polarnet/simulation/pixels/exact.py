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
from polarnet.simulation.pixels.course import empty_course, keep, put, take
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
ENOUGH = 2000  # pixels on the course that make it worth following them
LOG2_E = np.float32(1 / math.log(2))
# 2^f - 1 on [-1/2, 1/2]: f times a polynomial (Taylor's to f^6, whose error is below 1e-7), in pairs (Estrin's scheme)
# because processors wait less for short chains
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
    """int32, fired so far: numbers the draws of the leak's jitter"""
    next_shot_us: np.ndarray


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
        events=np.zeros(n, np.int32),
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
            pixels.leak[i] = jittered_leak(pixels.leak_nominal[i], physics.leak_jitter, jitter_key, i, 0)
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
    words = flag_words(rows * w)
    course = empty_course(ENOUGH + rows * w + SPARE)
    keys = key_for(key, randomness.LEAK_JITTER, plane), key_for(key, randomness.SHOT_NOISE, plane)
    pending = pending_events(h * w, columns.exact_us.size > 0)
    soonest_us = np.array([pixels.next_shot_us[y * w : (y + rows) * w].min() for y in range(0, h, rows)])
    used = 0
    for k in range(times_us.size - 1):
        start_us, stop_us = times_us[k], times_us[k + 1]
        n, active, shooting = 0, 0, soonest_us.min() < stop_us
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
                _difference(dn, response, pixels.dn[first:stop], pixels.linlog[first:stop], rise)
            change, leak = pixels.change[first:stop], pixels.leak[first:stop]
            threshold_on, threshold_off = pixels.threshold_on[first:stop], pixels.threshold_off[first:stop]
            fires = flags_of(words, stop - first)
            _move(change, leak, rise, np.float32(stop_us - start_us), before, threshold_on, threshold_off, fires)
            if soonest_us[y // rows] < stop_us:
                _flag_shots(pixels.next_shot_us[first:stop], stop_us, fires)
            active = _line_up(words, first, before, rise, pixels, start_us, stop_us, course, active)
            if active >= ENOUGH or y + rows >= h:
                pending, n = _fire(pixels, physics, keys, course, active, shooting, w, start_us, stop_us, pending, n)
                active = 0
        if shooting:
            for y in range(0, h, rows):
                if soonest_us[y // rows] < stop_us:
                    soonest_us[y // rows] = pixels.next_shot_us[y * w : (y + rows) * w].min()
        base_us = math.floor(start_us)
        columns, used = write_in_order(
            pending, n, np.int64(base_us), np.int64(math.ceil(stop_us) - base_us), columns, used
        )
    return columns, used


@inlined
def _difference(dn, response, dn_before, response_before, rise):
    for j in range(rise.size):
        rise[j] = response[j] - response_before[j]
        dn_before[j], response_before[j] = dn[j], response[j]


@inlined
def _filter(dn, response, dn_before, response_before, lag, rate, rise):
    """First-order low-pass of a response that is linear in time, with the bandwidth at the mean light of the step.

    Solved exactly over the step, so that the result does not hang on the frame rate: with a = bandwidth * dt,
    lag <- lag exp(-a) - (change of response) (1 - exp(-a)) / a.
    """
    c1, c2, c3, c4, c5, c6, c7 = EXP2
    half_rate = np.float32(0.5) * rate
    for j in range(dn.size):
        a = min(half_rate * ((dn[j] + dn_before[j]) + np.float32(2 * DARK_OFFSET)), np.float32(80))
        per_a = np.float32(1) / a
        whole = np.rint(-a * LOG2_E)
        f = -a * LOG2_E - whole
        scale = np.float32(np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32))
        square = f * f
        low, high = (c1 + c2 * f) + (c3 + c4 * f) * square, (c5 + c6 * f) + c7 * square
        above_one = f * (low + high * (square * square))
        decayed = (np.float32(1) - scale) - scale * above_one  # 1 - exp(-a), accurate for small a as well
        step = response[j] - response_before[j]
        lag_after = (lag[j] - lag[j] * decayed) - step * (decayed * per_a)
        lag_after = lag_after if abs(lag_after) > SMALLEST_LAG else np.float32(0)
        rise[j] = step + (lag_after - lag[j])
        lag[j], dn_before[j], response_before[j] = lag_after, dn[j], response[j]


@inlined
def _move(change, leak, rise, dt_us, before, threshold_on, threshold_off, fires):
    """Advance each change by its rise and leak as if nothing fired; flag pixels beyond a threshold at either end."""
    for j in range(rise.size):
        start = change[j]
        stop = start + (rise[j] + leak[j] * dt_us)
        fires[j] = (max(start, stop) >= threshold_on[j]) | (min(start, stop) <= -threshold_off[j])
        before[j], change[j] = start, stop


@inlined
def _flag_shots(next_shot_us, stop_us, fires):
    for j in range(fires.size):
        fires[j] |= next_shot_us[j] < stop_us


@inlined
def _line_up(words, first, before, rise, pixels, start_us, stop_us, course, active):
    """Append the flagged pixels of a strip that begins at pixel `first` to the course; how many are on it then."""
    pixel, index = course.pixel[active:], course.entry[active:]
    stop = active + flagged(words, before.size, index, pixel)
    pixel, index = course.pixel[active:stop], course.entry[active:stop]
    for a in range(stop - active):
        pixel[a] = first + index[a]
    take(before, index, course.change[active:stop])
    take(rise, index, course.drift[active:stop])
    take(pixels.threshold_on, pixel, course.threshold_on[active:stop])
    take(pixels.threshold_off, pixel, course.threshold_off[active:stop])
    take(pixels.leak, pixel, course.leak[active:stop])
    take(pixels.leak_nominal, pixel, course.leak_nominal[active:stop])
    take(pixels.events, pixel, course.events[active:stop])
    take(pixels.last_event_us, pixel, course.last_event[active:stop])
    per_us = 1 / (stop_us - start_us)
    for a in range(active, stop):
        course.drift[a] *= per_us
        course.last_event[a] -= start_us
        course.now[a] = 0.0
    return stop


@inlined
def _fire(pixels, physics, keys, course, active, shooting, w, start_us, stop_us, pending, n):
    """Follow the pixels on `course` through a step, in rounds: in each, a pixel fires once at most.

    Rounds instead of pixels, and choices instead of branches, because what a pixel does next is not to be guessed.
    Returns the pending events and their number.
    """
    dt = stop_us - start_us
    jitter = physics.leak_jitter if physics.leak_rate_hz > 0 else 0.0
    while active > 0:
        while n + active > pending.events.size:
            pending = roomier(pending)
        _cross(course, active, physics.refractory_s * 1e6, dt)
        course.again[:active] = 0
        if shooting:
            _shoot(pixels, physics, keys[1], course, active, start_us, stop_us)
        _settle(course, active, jitter, keys[0], dt)
        n = _collect(course, active, w, start_us, pending, n)
        _hand_back(pixels, course, active, start_us)
        active = keep(course, active)
    return pending, n


@inlined
def _cross(course, active, refractory_us, dt):
    """When each pixel next meets a threshold, and what of its change is left then."""
    for a in range(active):
        threshold_on, threshold_off = np.float64(course.threshold_on[a]), np.float64(course.threshold_off[a])
        leak, change, now, last = np.float64(course.leak[a]), course.change[a], course.now[a], course.last_event[a]
        slope = course.drift[a] + leak
        ready = max(now, last + refractory_us)
        at_ready = change + slope * (ready - now)
        on = (at_ready >= threshold_on) | ((at_ready > -threshold_off) & (slope > 0))
        over, under = at_ready - threshold_on, -threshold_off - at_ready
        excess = over if on else under
        wait = abs(excess / slope)
        event = ready + (0.0 if excess >= 0 else wait)
        left = max(excess, 0.0)  # a crossing leaves nothing of the change; after waiting, the excess remains
        left = left if on else -left
        leaked = on & (leak * (event - last) > 0.5 * threshold_on)
        fires = event < dt
        course.kind[a] = event_of(0, 0, on, LEAK if leaked else SIGNAL)
        course.fires[a], course.after[a], course.since[a] = fires, left if fires else change, event if fires else now


@compiled
def _shoot(pixels, physics, key, course, active, start_us, stop_us):
    """Put the shot noise that comes before a pixel's next crossing in its place."""
    dt = stop_us - start_us
    for a in range(active):
        i = course.pixel[a]
        shot = pixels.next_shot_us[i] - start_us
        if shot < (course.since[a] if course.fires[a] else dt):
            on, off = np.float64(pixels.threshold_on[i]), np.float64(pixels.threshold_off[i])
            happens, is_on = _shot(physics, key, i, start_us + shot, on, off, pixels.dn[i])
            pixels.next_shot_us[i] += _until_next_shot(physics, key, i, start_us + shot, on, off)
            fires = happens & (shot >= course.last_event[a] + physics.refractory_s * 1e6)
            course.kind[a], course.fires[a] = event_of(0, 0, is_on, SHOT), fires
            course.after[a], course.since[a] = (0.0, shot) if fires else (course.change[a], course.now[a])
        course.again[a] = pixels.next_shot_us[i] < stop_us


@inlined
def _settle(course, active, jitter, key, dt):
    """Where pixels are after their events, and whether they are to be followed further."""
    pixel, events, leak_nominal = course.pixel[:active], course.events[:active], course.leak_nominal[:active]
    leak, last_event, fires = course.leak[:active], course.last_event[:active], course.fires[:active]
    for a in range(active):
        events[a] += fires[a]
        if jitter > 0:
            drawn = jittered_leak(leak_nominal[a], jitter, key, pixel[a], events[a])
            leak[a] = drawn if fires[a] else leak[a]
    for a in range(active):
        after, since = course.after[a], course.since[a]
        last_event[a] = since if fires[a] else last_event[a]
        end = after + (course.drift[a] + leak[a]) * (dt - since)
        beyond = (max(after, end) >= course.threshold_on[a]) | (min(after, end) <= -course.threshold_off[a])
        course.at_end[a] = end
        course.again[a] |= fires[a] & beyond


@inlined
def _collect(course, active, w, start_us, pending, n):
    """Append the events of a round to the pending ones; how many those are then."""
    since_whole_us, per_row = start_us - math.floor(start_us), 1 / w
    for a in range(active):
        y = np.int64((course.pixel[a] + 0.5) * per_row)
        place = place_of(y, course.pixel[a] - y * w)
        course.kind[a] |= event_of(since_whole_us + course.since[a], place, 0, 0)
    for a in range(active):
        at = np.uint64(n)  # what does not fire is overwritten by the next
        pending.events[at] = course.kind[a]
        if pending.exact_us.size:
            pending.exact_us[at] = start_us + course.since[a]
        n += course.fires[a]
    return n


@inlined
def _hand_back(pixels, course, active, start_us):
    """What has become of the pixels, for the next step."""
    pixel = course.pixel[:active]
    for a in range(active):
        course.now[a] = start_us + course.last_event[a]
    put(course.at_end, pixel, pixels.change)
    put(course.leak, pixel, pixels.leak)
    put(course.events, pixel, pixels.events)
    put(course.now, pixel, pixels.last_event_us)


@inlined
def _bits(key, i, time_us):
    """Random bits of what pixel i draws at a time."""
    return mixed(key ^ np.uint64(np.float64(time_us).view(np.int64)), i)


@compiled
def jittered_leak(nominal, jitter, key, i, number):
    """The leak of pixel i from its event of this number to its next."""
    return nominal * np.float32(
        max(1 - jitter * rough_normal(mixed(key, (np.uint64(i) << np.uint64(32)) + np.uint64(number))), 0.0)
    )


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
