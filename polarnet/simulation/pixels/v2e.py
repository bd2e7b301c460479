"""The pixel of v2e (Hu, Liu, Delbruck, CVPRW 2021), event for event what its code gives.

Its precision is part of the model, since 8-bit light meets thresholds exactly: the state is float32, and float64 once
the photoreceptor's low-pass is on; thresholds times counts are float32; stamps within a step are float32 seconds.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import compiled
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.columns import LEAK, SHOT, SIGNAL, sort_ties, with_room
from polarnet.simulation.pixels.light import FLOATS, intensity_rows, linlog_8bit, linlog_as_v2e
from polarnet.simulation.pixels.randomness import key_for, mixed, rough_normals, uniform
from polarnet.simulation.pixels.strips import SPARE, flag_words, flagged, flags_of, rows_of_strip

THRESHOLD_FLOOR = 0.01  # v2e clips drawn thresholds here
DARK_OFFSET = 20.0  # DN: bandwidth and shot noise follow (DN + 20) / 275
SATURATION = 275.0
SHOT_NOISE_SLOPE = 0.75  # shot noise falls by this fraction from dark to bright
NEARLY = np.float32(1.000001)  # widens a first look at thresholds by more than rounding; exact counts follow
PIXEL, PLACE, CROSSED, ACCEPTED = range(4)  # columns of the list of firing pixels; PLACE = row * 2^16 + column


class Pixels(NamedTuple):
    """State of one plane, one array per quantity, [h * w]."""

    memory: np.ndarray
    """log intensity at the last event, less what leaked"""
    filtered: np.ndarray
    """log intensity behind the photoreceptor's low-pass"""
    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak_factor: np.ndarray
    """of the nominal leak rate, frozen per pixel"""
    refractory_since: np.ndarray
    """float32 seconds of the last event that a refractory period counts from"""
    last_event_us: np.ndarray
    """kept only while events are labelled: what leaked since then tells a leak event from a signal event"""


class Physics(NamedTuple):
    """What the pixels of a sensor have in common, in v2e's units."""

    threshold_on: float
    threshold_off: float
    threshold_sigma: float
    cutoff_hz: float
    leak_rate_hz: float
    leak_jitter: float
    noise_rate_cov_decades: float
    shot_noise_rate_hz: float
    refractory_s: float


def initial(h: int, w: int, physics: Physics, key: np.uint64, plane: int) -> Pixels:
    """Pixels before their first frame, with this plane's own mismatch."""
    n = h * w
    real = np.float64 if physics.cutoff_hz > 0 else np.float32
    return Pixels(
        memory=np.zeros(n, real),
        filtered=np.zeros(n, real),
        threshold_on=threshold_map(
            physics.threshold_on, physics.threshold_sigma, n, key, randomness.THRESHOLD_ON, plane
        ),
        threshold_off=threshold_map(
            physics.threshold_off, physics.threshold_sigma, n, key, randomness.THRESHOLD_OFF, plane
        ),
        leak_factor=leak_factor_map(physics.noise_rate_cov_decades, n, key, plane),
        refractory_since=np.full(n, -physics.refractory_s, np.float32),
        last_event_us=np.zeros(n, np.float64),
    )


def threshold_map(nominal: float, sigma: float, n: int, key: np.uint64, purpose: int, plane: int) -> np.ndarray:
    """Thresholds N(nominal, sigma) of n pixels, at least 0.01, float32."""
    if sigma == 0:
        return np.full(n, nominal, np.float32)
    deviations = randomness.normal_map(key, purpose, plane, n)
    return np.maximum(np.float32(nominal) + np.float32(sigma) * deviations, np.float32(THRESHOLD_FLOOR))


def leak_factor_map(cov_decades: float, n: int, key: np.uint64, plane: int) -> np.ndarray:
    """10^(cov_decades * N(0, 1)) of n pixels, float32."""
    if cov_decades == 0:
        return np.ones(n, np.float32)
    return np.float32(10) ** (np.float32(cov_decades) * randomness.normal_map(key, randomness.NOISE_RATE, plane, n))


@compiled
def _respond(light, k, y, w, dn, linlog):
    intensity_rows(light, k, y, w, dn)
    if light.kind == FLOATS:
        linlog_as_v2e(dn, linlog)
    else:
        linlog_8bit(dn, linlog)


@compiled
def start(light, pixels, physics, h, w, time_us, key, plane):
    """The first frame: filter and memory take its value, nothing fires."""
    dn, linlog = np.empty(h * w, np.float32), np.empty(h * w, np.float32)
    _respond(light, 0, 0, w, dn, linlog)
    pixels.filtered[:] = linlog
    pixels.memory[:] = linlog
    pixels.last_event_us[:] = time_us


@compiled
def advance(light, offset, pixels, physics, h, w, times_us, step, key, plane, columns):
    """Run steps times_us[k] .. times_us[k + 1] under light[offset + k]; the columns and how many events they hold."""
    rows = rows_of_strip(h, w)
    strip = np.empty((3, rows * w), np.float32)
    words, candidates = flag_words(rows * w), np.empty((2, rows * w + SPARE), np.int32)
    firing, order = np.empty((h * w + 1, 4), np.int32), np.empty(h * w + 1, np.int32)
    jitter_key, shot_key = key_for(key, randomness.LEAK_JITTER, plane), key_for(key, randomness.SHOT_NOISE, plane)
    ceiling = physics.threshold_on / pixels.threshold_on.min() + physics.threshold_off / pixels.threshold_off.min()
    used = 0
    for k in range(times_us.size - 1):
        dt = (times_us[k + 1] - times_us[k]) * 1e-6
        step_key = mixed(jitter_key, step + k)
        n, most = 0, 0
        for y in range(0, h, rows):
            first, stop = y * w, min(y + rows, h) * w
            dn, linlog, noise = strip[0, : stop - first], strip[1, : stop - first], strip[2, : stop - first]
            filtered, memory = pixels.filtered[first:stop], pixels.memory[first:stop]
            threshold_on, threshold_off = pixels.threshold_on[first:stop], pixels.threshold_off[first:stop]
            _respond(light, offset + k, y, w, dn, linlog)
            if physics.cutoff_hz > 0:
                _filter(linlog, dn, filtered, 2 * math.pi * physics.cutoff_hz * dt)
            else:
                filtered[:] = linlog
            if physics.leak_rate_hz > 0:
                rough_normals(step_key, first, noise)
                _leak(memory, threshold_on, pixels.leak_factor[first:stop], noise, dt, physics)
            fires = flags_of(words, stop - first)
            _flag(filtered, memory, threshold_on, threshold_off, fires)
            n, most = _count(
                filtered, memory, threshold_on, threshold_off, physics, words, y, w, candidates, firing, n, most
            )
        before = used
        columns, used = _emit(pixels, physics, times_us[k], times_us[k + 1], firing, order, n, most, columns, used)
        if dt < 1e-6 * most:
            sort_ties(columns, before, used)
        if physics.shot_noise_rate_hz > 0:
            stop_us = times_us[k + 1]
            columns, used = _shoot(
                light, offset + k, pixels, physics, h, w, stop_us, dt, ceiling, mixed(shot_key, step + k), columns, used
            )
    return columns, used


@compiled
def _filter(linlog, dn, filtered, rate):
    """First-order low-pass whose bandwidth grows with light: rate = 2 pi cutoff dt at full brightness."""
    per_dn = rate / SATURATION
    for j in range(dn.size):
        share = min(1.0, (np.float64(dn[j]) + DARK_OFFSET) * per_dn)
        filtered[j] += share * (linlog[j] - filtered[j])


@compiled
def _leak(memory, threshold_on, leak_factor, noise, dt, physics):
    """The reset switch leaks, so the reference sinks and a dark, motionless scene keeps firing ON events."""
    one, dt, rate, jitter = (
        np.float32(1),
        np.float32(dt),
        np.float32(physics.leak_rate_hz),
        np.float32(physics.leak_jitter),
    )
    for j in range(memory.size):
        memory[j] -= dt * (rate * leak_factor[j] * (one - jitter * noise[j])) * threshold_on[j]


@compiled
def _flag(filtered, memory, threshold_on, threshold_off, fires):
    for j in range(filtered.size):
        change = (filtered[j] - memory[j]) * NEARLY
        fires[j] = (change >= threshold_on[j]) | (-change >= threshold_off[j])


@compiled
def _count(filtered, memory, threshold_on, threshold_off, physics, words, y, w, candidates, firing, n, most):
    """Append the flagged pixels of a strip from row y on, with the thresholds each has crossed, negative for OFF.

    Returns the length of the list and the largest count.
    """
    found = flagged(words, filtered.size, candidates[0], candidates[1])
    first, row_end = y * w, w
    exact_nominal = memory.itemsize == 8 and physics.threshold_sigma == 0  # v2e divides float64 by a Python float
    for c in range(found):
        j = np.uint64(candidates[0, c])  # unsigned: numba checks other indices for being negative
        while candidates[0, c] >= row_end:
            y, row_end = y + 1, row_end + w
        change = np.float64(filtered[j] - memory[j])
        on, off = np.float64(threshold_on[j]), np.float64(threshold_off[j])
        if exact_nominal:
            on, off = physics.threshold_on, physics.threshold_off
        crossed = np.int32(change / (on if change > 0 else off))
        entry = np.uint64(n)
        firing[entry, PIXEL], firing[entry, CROSSED], firing[entry, ACCEPTED] = first + candidates[0, c], crossed, 0
        firing[entry, PLACE] = y << 16 | (candidates[0, c] - row_end + w)
        n += crossed != 0
        most = max(most, abs(crossed))
    return n, most


@compiled
def _emit(pixels, physics, start_us, stop_us, firing, order, n, most, columns, used):
    """Events of one step, slot by slot: the busiest pixel of the plane sets the number of slots for all.

    Events within the refractory period of their pixel are not consumed: they try again in the next step.
    """
    refractory = physics.refractory_s > (stop_us - start_us) * 1e-6 / max(most, 1)
    least = np.float32(physics.refractory_s) if refractory else np.float32(-np.inf)
    first = np.float32((start_us + (stop_us - start_us) / max(most, 1)) * 1e-6)
    last = np.float32(stop_us * 1e-6)
    interval = np.float32((last - first) / np.float32(max(most - 1, 1)))
    since = pixels.refractory_since
    for a in range(n):
        order[a] = a
    active = n
    for slot in range(1, most + 1):
        exact_us = start_us + (stop_us - start_us) * slot / most
        # torch.linspace, which v2e calls, counts from both ends
        stamp = (
            first + interval * np.float32(slot - 1) if slot <= most // 2 else last - interval * np.float32(most - slot)
        )
        columns = with_room(columns, used, active + 1)
        t, x, y, p = columns.t[used:], columns.x[used:], columns.y[used:], columns.p[used:]
        t_us, written, remaining = np.int64(np.rint(exact_us)), 0, 0
        for a in range(active):  # without branches: an event that is suppressed is overwritten by the next
            e, at = np.uint64(order[a]), np.uint64(written)
            i, place, crossed = np.uint64(firing[e, PIXEL]), firing[e, PLACE], firing[e, CROSSED]
            accepted = np.float32(stamp - since[i]) > least
            if refractory:
                since[i] = stamp if accepted else since[i]
            polarity = np.int32(1) if crossed > 0 else np.int32(-1)
            t[at], x[at], y[at], p[at] = t_us, place & 0xFFFF, place >> 16, polarity
            firing[e, ACCEPTED] += polarity if accepted else np.int32(0)
            if columns.label.size and accepted:
                columns.label[used + written] = _label(pixels, physics, i, exact_us, polarity)
            if columns.exact_us.size:
                columns.exact_us[used + written] = exact_us
            written += int(accepted)
            order[np.uint64(remaining)] = e
            remaining += abs(crossed) > slot
        used += written
        active = remaining
    _consume(pixels, firing, n)
    return columns, used


@compiled
def _consume(pixels, firing, n):
    """Move each memory by the thresholds whose events were accepted; the remainder of the change is kept."""
    for a in range(n):
        i, accepted = np.uint64(firing[a, PIXEL]), firing[a, ACCEPTED]
        on, off = pixels.threshold_on[i], pixels.threshold_off[i]
        pixels.memory[i] += (on if accepted > 0 else off) * np.float32(accepted)


@compiled
def _label(pixels, physics, i, time_us, polarity):
    """LEAK for an ON event of which the leak made more than half a threshold."""
    leaked = physics.leak_rate_hz * pixels.leak_factor[i] * (time_us - pixels.last_event_us[i]) * 1e-6
    pixels.last_event_us[i] = time_us
    return LEAK if polarity > 0 and leaked > 0.5 else SIGNAL


@compiled
def _shoot(light, k, pixels, physics, h, w, stop_us, dt, ceiling, key, columns, used):
    """Shot noise of one step: each pixel fires with a small probability that falls with light.

    Pixels that would fire in the dark at the plane's lowest thresholds are found by geometric skipping, then thinned.
    """
    half_rate = physics.shot_noise_rate_hz / 2 * dt
    ceiling = min(ceiling * half_rate, 1.0)
    dn = np.empty(w, np.float32)
    before, row, i, draw = used, -1, -1, 0
    while True:
        gap = math.log(uniform(mixed(key, draw))) / math.log1p(-ceiling) if ceiling < 1 else 0.0
        if gap >= h * w - 1 - i:
            break
        i += 1 + int(gap)
        if i // w != row:
            row = i // w
            intensity_rows(light, k, row, w, dn)
        chance = half_rate * (1 - SHOT_NOISE_SLOPE * (np.float64(dn[i - row * w]) + DARK_OFFSET) / SATURATION)
        on = chance * physics.threshold_on / pixels.threshold_on[i]
        off = chance * physics.threshold_off / pixels.threshold_off[i]
        u = uniform(mixed(key, draw + 1)) * ceiling
        draw += 2
        if u >= on + off:
            continue
        columns = with_room(columns, used, 1)
        columns.t[used], columns.x[used], columns.y[used] = np.int64(np.rint(stop_us)), i - row * w, row
        columns.p[used] = 1 if u < on else -1
        if columns.label.size:
            columns.label[used] = SHOT
            pixels.last_event_us[i] = stop_us
        if columns.exact_us.size:
            columns.exact_us[used] = stop_us
        pixels.memory[i] = pixels.filtered[i]
        used += 1
    tied = before
    while used > before and tied > 0 and columns.t[tied - 1] >= columns.t[before]:
        tied -= 1
    sort_ties(columns, tied, used)
    return columns, used
