"""The pixel model `exact`: v2e's physics in continuous time, with each event at its own threshold crossing.

Between frames the filtered log intensity is linear in time. Leak, refractory period and shot noise do not depend on
the frame rate. The leak of a pixel has a random phase at the start and a new rate after every event. A threshold
crossing within the refractory period waits for its end and fires there if the change still exceeds the threshold.
Shot noise is a Poisson process of each pixel. As the frame rate grows, the signal events of v2e converge to these.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.runtime.compilation import ZERO, borrowing, compiled, inlined
from polarnet.simulation.pixels import active as strips
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.active import empty_active, flagged, gather, keep_continuing, scatter
from polarnet.simulation.pixels.columns import Steps, event_of, place_of, roomier, write_in_order
from polarnet.simulation.pixels.light import Light, intensity_rows, respond
from polarnet.simulation.pixels.physics import (
    DARK_OFFSET,
    DARK_SHOT_NOISE,
    SATURATION,
    Physics,
    mismatch,
    shot_noise_fraction,
    wander,
)
from polarnet.simulation.pixels.randomness import key_for, mixed, rough_normal, uniform

EIGHT_BIT_VIDEO = False
MIN_LAG = np.float32(1e-12)  # a smaller lag becomes 0: processors are slow with denormal numbers
LONG_AGO_US = -1e18
EPSILON = 2.0**-52
BATCH = 2000  # minimum number of active pixels that are followed in one pass, except for the last strip
LOG2_E = np.float32(1 / math.log(2))
# 2^f - 1 on [-1/2, 1/2]: f times a polynomial (Taylor's to f^6, whose error is below 1e-7), in pairs (Estrin's scheme)
# because processors wait less for short chains
EXP2 = tuple(np.float32(math.log(2) ** k / math.factorial(k)) for k in range(1, 8))


class Pixels(NamedTuple):
    """State of one channel, one array [h * w] per quantity; float32 unless stated."""

    change: np.ndarray  # filtered log intensity since the last event, leak included
    dn: np.ndarray  # light of the last frame, DN
    response: np.ndarray  # response to that light
    lag: np.ndarray  # output of the photoreceptor minus response
    noise: np.ndarray  # of the photoreceptor, natural-log intensity; empty without it
    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak_nominal: np.ndarray  # log intensity per microsecond, frozen per pixel
    leak: np.ndarray  # leak until the next event, jitter included
    last_event_us: np.ndarray  # float64
    events: np.ndarray  # int32, number of events so far; numbers the draws of the leak's jitter
    next_shot_us: np.ndarray  # float64, time of the next candidate for a shot-noise event


class Step(NamedTuple):
    """One step of a channel."""

    physics: Physics
    start_us: float
    stop_us: float
    duration_us: float
    refractory_us: float
    held_us: float  # the refractory period if the pixel is held in reset for it, else 0
    jitter: float  # relative standard deviation of the leak; 0 where nothing leaks
    leak_key: np.uint64
    shot_key: np.uint64
    has_shots: bool  # whether a shot-noise candidate of any pixel falls into the step


def start(light: Light, steps: Steps) -> Pixels:
    """Pixels adapted to the first frame, with the thresholds and leak rates drawn for this channel."""
    physics, n = steps.physics, steps.height * steps.width
    threshold_on, threshold_off, leak_factor = mismatch(physics, n, steps.key, steps.channel)
    change, dn, response, lag, leak = np.zeros((5, n), np.float32)
    intensity_rows(light, ZERO, ZERO, steps.width, dn)
    respond(dn, physics, response)
    pixels = Pixels(
        change, dn, response, lag,
        np.zeros(n if physics.photoreceptor_noise > 0 else 0, np.float32),
        threshold_on, threshold_off,
        np.float32(physics.leak_rate_hz * 1e-6) * leak_factor * threshold_on,
        leak,
        np.full(n, LONG_AGO_US), np.zeros(n, np.int32), np.full(n, np.inf),
    )  # fmt: skip
    _draw_phases(pixels, steps)
    return pixels


@compiled
def _draw_phases(pixels, steps):
    """Draw each pixel's phase of the leak and first shot-noise candidate."""
    physics, time_us = steps.physics, steps.times_us[0]
    phase_key = key_for(steps.key, randomness.LEAK_PHASE, steps.channel)
    jitter_key = key_for(steps.key, randomness.LEAK_JITTER, steps.channel)
    shot_key = key_for(steps.key, randomness.SHOT_NOISE, steps.channel)
    for i in range(pixels.dn.size):
        if physics.leak_rate_hz > 0:
            pixels.leak[i] = _jittered_leak(pixels.leak_nominal[i], physics.leak_jitter, jitter_key, i, 0)
            pixels.change[i] = uniform(mixed(phase_key, i)) * pixels.threshold_on[i]
            if pixels.leak[i] > 0:
                pixels.last_event_us[i] = time_us - pixels.change[i] / pixels.leak[i]
        if physics.shot_noise_rate_hz > 0:
            on, off = pixels.threshold_on[i], pixels.threshold_off[i]
            pixels.next_shot_us[i] = time_us + _until_next_shot(physics, shot_key, i, time_us, on, off)


@compiled
def advance(light, pixels, steps, columns):
    """Advance the pixels through `steps`, in place; return the columns with the events, and the number of events."""
    physics, times_us, h, w = steps.physics, steps.times_us, steps.height, steps.width
    rows = strips.rows_of_strip(h, w)
    strip, active = np.empty((4, rows * w), np.float32), empty_active(BATCH, rows * w)
    leak_key = key_for(steps.key, randomness.LEAK_JITTER, steps.channel)
    shot_key = key_for(steps.key, randomness.SHOT_NOISE, steps.channel)
    noise_key = key_for(steps.key, randomness.PHOTORECEPTOR, steps.channel)
    jitter = physics.leak_jitter if physics.leak_rate_hz > 0 else 0.0
    pending = np.empty(h * w, np.int64)
    soonest_us = np.array([pixels.next_shot_us[y * w : (y + rows) * w].min() for y in range(0, h, rows)])
    used = ZERO
    for k in range(times_us.size - 1):
        start_us, stop_us, dt_us = times_us[k], times_us[k + 1], times_us[k + 1] - times_us[k]
        has_shots, refractory_us = soonest_us.min() < stop_us, physics.refractory_s * 1e6
        held_us = refractory_us if physics.holds else 0.0
        step = Step(physics, start_us, stop_us, dt_us, refractory_us, held_us, jitter, leak_key, shot_key, has_shots)
        n, count = ZERO, ZERO
        for y in range(0, h, rows):
            first, stop = y * w, min(y + rows, h) * w
            dn, response = strip[0, : stop - first], strip[1, : stop - first]
            rise, before = strip[2, : stop - first], strip[3, : stop - first]
            fires = strips.flags_of(active.words, stop - first)
            dn_before, response_before = pixels.dn[first:stop], pixels.response[first:stop]
            intensity_rows(light, steps.first_frame + k, y, w, dn)
            respond(dn, physics, response)
            if physics.cutoff_hz > 0:
                rate = np.float32(2e-6 * math.pi * physics.cutoff_hz * dt_us / SATURATION)
                _filter(dn, response, dn_before, response_before, pixels.lag[first:stop], rate, rise)
            else:
                _difference(dn, response, dn_before, response_before, rise)
            if physics.photoreceptor_noise > 0:
                key = mixed(noise_key, steps.first_number + k)
                wander(pixels.noise[first:stop], key, first, physics, dt_us * 1e-6, rise)
            if held_us > 0:
                _hold(pixels.last_event_us[first:stop], pixels.leak[first:stop], step, rise)
            _move(pixels, first, rise, np.float32(dt_us), before, fires)
            if soonest_us[y // rows] < stop_us:
                _flag_shots(pixels.next_shot_us[first:stop], stop_us, fires)
            count = _activate(pixels, first, before, rise, step, active, count)
            if count >= BATCH or y + rows >= h:
                pending, n = _fire(pixels, step, active, count, w, pending, n)
                count = ZERO
        if has_shots:
            for y in range(0, h, rows):
                if soonest_us[y // rows] < stop_us:
                    soonest_us[y // rows] = pixels.next_shot_us[y * w : (y + rows) * w].min()
        columns, used = write_in_order(steps, k, pending, n, columns, used)
    return columns, used


@borrowing
def _difference(dn, response, dn_before, response_before, rise):
    for j in range(rise.size):
        rise[j] = response[j] - response_before[j]
        dn_before[j], response_before[j] = dn[j], response[j]


@borrowing
def _filter(dn, response, dn_before, response_before, lag, rate, rise):
    """First-order low-pass of a response that is linear in time, with the bandwidth at the mean light of the step.

    The solution over the step is exact, so that the result does not depend on the frame rate. With
    a = bandwidth * dt: lag <- lag exp(-a) - (change of response) (1 - exp(-a)) / a.
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
        lag_after = lag_after if abs(lag_after) > MIN_LAG else np.float32(0)
        rise[j] = step + (lag_after - lag[j])
        lag[j], dn_before[j], response_before[j] = lag_after, dn[j], response[j]


@borrowing
def _hold(last_event_us, leak, step, rise):
    """Take from each rise, and from the leak that `_move` adds to it, the part of the step that the pixel is held."""
    dt_us = np.float32(step.duration_us)
    for j in range(rise.size):
        held = np.float32(max(last_event_us[j] + step.held_us - step.start_us, 0.0) / step.duration_us)
        if held > 0:
            held = min(held, np.float32(1))
            rise[j] -= held * (rise[j] + leak[j] * dt_us)


@borrowing
def _move(pixels, first, rise, dt_us, before, fires):
    """Advance each change by its rise and leak as if nothing fired; flag pixels beyond a threshold at either end."""
    strip = slice(first, first + rise.size)
    change, leak = pixels.change[strip], pixels.leak[strip]
    threshold_on, threshold_off = pixels.threshold_on[strip], pixels.threshold_off[strip]
    for j in range(rise.size):
        start = change[j]
        stop = start + (rise[j] + leak[j] * dt_us)
        fires[j] = (max(start, stop) >= threshold_on[j]) | (min(start, stop) <= -threshold_off[j])
        before[j], change[j] = start, stop


@borrowing
def _flag_shots(next_shot_us, stop_us, fires):
    for j in range(fires.size):
        fires[j] |= next_shot_us[j] < stop_us


@borrowing
def _activate(pixels, first, before, rise, step, active, count):
    """Append the flagged pixels of the strip that begins at pixel `first` to the `count` active ones; returns `count`.

    `before` is the change at the start of the step, `rise` the rise of the filtered log intensity.
    """
    pixel, index = active.pixel[count:], active.scratch[count:]
    stop = count + flagged(active.words, before.size, index, pixel)
    pixel, index = active.pixel[count:stop], active.scratch[count:stop]
    for a in range(stop - count):
        pixel[a] = first + index[a]
    gather(before, index, active.change[count:stop])
    gather(rise, index, active.slope[count:stop])
    gather(pixels.threshold_on, pixel, active.threshold_on[count:stop])
    gather(pixels.threshold_off, pixel, active.threshold_off[count:stop])
    gather(pixels.leak, pixel, active.leak[count:stop])
    gather(pixels.leak_nominal, pixel, active.leak_nominal[count:stop])
    gather(pixels.events, pixel, active.events[count:stop])
    gather(pixels.last_event_us, pixel, active.last_event[count:stop])
    per_us = 1 / step.duration_us
    for a in range(count, stop):
        active.slope[a] *= per_us
        active.last_event[a] -= step.start_us
        active.now[a] = 0.0
        if step.held_us > 0:
            active.now[a] = min(max(active.last_event[a] + step.held_us, 0.0), step.duration_us)
            free = 1 - active.now[a] * per_us
            # undo `_hold`: the slope is that of the light alone
            active.slope[a] = (active.slope[a] + active.leak[a] * (1 - free)) / free if free > 0 else 0.0
    return stop


@compiled
def _fire(pixels, step, active, count, width, pending, n):
    """Follow the active pixels through a step, in rounds in which each pixel fires at most once.

    Rounds and selections instead of branches, because the branch is unpredictable. Returns the pending events and
    their number.
    """
    while count > 0:
        while n + count > pending.size:
            pending = roomier(pending)
        n, count = _fire_once(pixels, step, active, count, width, pending, n)
    return pending, n


@borrowing
def _fire_once(pixels, step, active, count, width, pending, n):
    """Run one round of `_fire`; return the numbers of pending events and of pixels that may fire in the next round."""
    _next_crossing(active, count, step)
    active.continues[:count] = 0
    if step.has_shots:
        _insert_shots(pixels, step, active, count)
    _move_on(active, count, step)
    n = _append_events(active, count, width, step.start_us, pending, n)
    _store_state(pixels, active, count, step.start_us)
    return n, keep_continuing(active, count)


@inlined
def _next_crossing(active, count, step):
    """Find when each pixel next fires, and its change right after."""
    refractory_us, duration_us = step.refractory_us, step.duration_us
    kept = 0.0 if step.held_us > 0 else 1.0
    for a in range(count):
        threshold_on, threshold_off = np.float64(active.threshold_on[a]), np.float64(active.threshold_off[a])
        leak, change, now, last = np.float64(active.leak[a]), active.change[a], active.now[a], active.last_event[a]
        slope = active.slope[a] + leak
        ready = max(now, last + refractory_us)
        at_ready = change + kept * slope * (ready - now)
        on = (at_ready >= threshold_on) | ((at_ready > -threshold_off) & (slope > 0))
        over, under = at_ready - threshold_on, -threshold_off - at_ready
        excess = over if on else under
        wait = abs(excess / slope)
        event = ready + (0.0 if excess >= 0 else wait)
        left = max(excess, 0.0)  # a crossing leaves nothing of the change; after waiting, the excess remains
        left = left if on else -left
        fires = event < duration_us
        active.event[a] = event_of(0, 0, on)
        active.fires[a] = fires
        active.next_change[a], active.next_now[a] = left if fires else change, event if fires else now


@borrowing
def _insert_shots(pixels, step, active, count):
    """Replace a pixel's next crossing by the first accepted shot-noise event before it, if there is one."""
    for a in range(count):
        i = active.pixel[a]
        on, off = np.float64(pixels.threshold_on[i]), np.float64(pixels.threshold_off[i])
        limit = active.next_now[a] if active.fires[a] else step.duration_us
        shot, replaced = pixels.next_shot_us[i] - step.start_us, False
        while shot < limit and not replaced:
            shot_us = step.start_us + shot
            accepted, is_on = _shot(step.physics, step.shot_key, i, shot_us, on, off, pixels.dn[i])
            pixels.next_shot_us[i] += _until_next_shot(step.physics, step.shot_key, i, shot_us, on, off)
            if accepted and shot >= active.last_event[a] + step.refractory_us:
                active.event[a], active.fires[a] = event_of(0, 0, is_on), 1
                active.next_change[a], active.next_now[a] = 0.0, shot
                replaced = True
            shot = pixels.next_shot_us[i] - step.start_us
        active.continues[a] = pixels.next_shot_us[i] < step.stop_us


@inlined
def _move_on(active, count, step):
    """Draw a new leak after each event, and find which pixels may fire again."""
    jitter, key, duration_us = step.jitter, step.leak_key, step.duration_us
    pixel, events, leak_nominal = active.pixel[:count], active.events[:count], active.leak_nominal[:count]
    leak, last_event, fires = active.leak[:count], active.last_event[:count], active.fires[:count]
    for a in range(count):
        events[a] += fires[a]
        if jitter > 0:
            drawn = _jittered_leak(leak_nominal[a], jitter, key, pixel[a], events[a])
            leak[a] = drawn if fires[a] else leak[a]
    for a in range(count):
        change, now = active.next_change[a], active.next_now[a]
        last_event[a] = now if fires[a] else last_event[a]
        free_us = max(duration_us - now - step.held_us * fires[a], 0.0)
        final = change + (active.slope[a] + leak[a]) * free_us
        beyond = (max(change, final) >= active.threshold_on[a]) | (min(change, final) <= -active.threshold_off[a])
        active.final_change[a] = final
        active.continues[a] |= fires[a] & beyond


@inlined
def _append_events(active, count, width, start_us, pending, n):
    """Append the events of a round to the n pending ones; returns their new number."""
    since_whole_us, per_row = start_us - math.floor(start_us), 1 / width
    for a in range(count):
        y = np.int64((active.pixel[a] + 0.5) * per_row)
        place = place_of(y, active.pixel[a] - y * width)
        active.event[a] |= event_of(since_whole_us + active.next_now[a], place, 0)
    for a in range(count):
        pending[np.uint64(n)] = active.event[a]  # overwritten by the next if the pixel does not fire
        n += active.fires[a]
    return n


@inlined
def _store_state(pixels, active, count, start_us):
    """Write the state at the end of the step back to the pixels, assuming that no further event follows."""
    pixel = active.pixel[:count]
    for a in range(count):
        active.now[a] = start_us + active.last_event[a]
    scatter(active.final_change, pixel, pixels.change)
    scatter(active.leak, pixel, pixels.leak)
    scatter(active.events, pixel, pixels.events)
    scatter(active.now, pixel, pixels.last_event_us)


@inlined
def _bits(key, i, time_us):
    """64 random bits of pixel i for a draw at `time_us`."""
    return mixed(key ^ np.uint64(np.float64(time_us).view(np.int64)), i)


@compiled
def _jittered_leak(nominal, jitter, key, i, number):
    """Leak of pixel i from event `number` to the next."""
    bits = mixed(key, (np.uint64(i) << np.uint64(32)) + np.uint64(number))
    return nominal * np.float32(max(1 - jitter * rough_normal(bits), 0.0))


@compiled
def _until_next_shot(physics, key, i, time_us, threshold_on, threshold_off):
    """Microseconds to the next event of a Poisson process with the pixel's shot-noise rate in the dark.

    Never less than float64 resolves at that time: the next draw of the pixel would be the same one.
    """
    share = physics.threshold_on / threshold_on + physics.threshold_off / threshold_off
    rate_hz = physics.shot_noise_rate_hz / 2 * DARK_SHOT_NOISE * share
    return max(-1e6 * math.log(uniform(_bits(key, i, time_us))) / rate_hz, abs(time_us) * EPSILON)


@compiled
def _shot(physics, key, i, time_us, threshold_on, threshold_off, dn):
    """Thin a shot-noise candidate to the rate at this light: (whether it becomes an event, whether it is ON)."""
    on, off = physics.threshold_on / threshold_on, physics.threshold_off / threshold_off
    chance = shot_noise_fraction(dn) / DARK_SHOT_NOISE
    u = uniform(_bits(~key, i, time_us))
    return u < chance, u < chance * on / (on + off)
