"""The pixel model `v2e` (Hu, Liu, Delbruck, CVPRW 2021): the same events as the published code.

Precision is part of the model, since 8-bit light meets thresholds exactly. The state is float32, or float64 with the
photoreceptor's low-pass; thresholds times counts are float32; stamps within a step are float32 seconds.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import ONE, ZERO, borrowing, compiled
from polarnet.simulation.pixels import physics, randomness
from polarnet.simulation.pixels.active import SPARE, flag_words, flagged, flags_of, rows_of_strip
from polarnet.simulation.pixels.columns import first_tied, sort_ties, with_room
from polarnet.simulation.pixels.light import intensity_rows, linlog_8bit, linlog_as_v2e
from polarnet.simulation.pixels.physics import DARK_OFFSET, SATURATION, Physics, mismatch, shot_noise_fraction
from polarnet.simulation.pixels.randomness import key_for, mixed, rough_normals, uniform

EIGHT_BIT_VIDEO = True
NEARLY = np.float32(1.000001)  # enlarges changes by more than rounding in a first test; `_count` then counts exactly
PIXEL, PLACE, CROSSED, ACCEPTED = range(4)  # columns of the list of firing pixels; PLACE = row * 2^16 + column

physics_of = physics.physics_of


class Pixels(NamedTuple):
    """State of one channel, one array [h * w] per quantity; float32 unless stated."""

    memory: np.ndarray  # log intensity at the last event, less what leaked; float64 with a low-pass
    filtered: np.ndarray
    """Log intensity behind the low-passes of photoreceptor and source follower; float64 with a low-pass."""
    photoreceptor: np.ndarray  # float64, log intensity between the two; empty without a source follower
    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak_factor: np.ndarray  # leak rate relative to the nominal rate, frozen per pixel
    refractory_since: np.ndarray  # time in seconds of the last event that started a refractory period


class Step(NamedTuple):
    """One step of a channel."""

    physics: Physics
    start_us: float
    stop_us: float
    duration_s: float
    leak_key: np.uint64
    shot_key: np.uint64
    max_shot_share: float
    """Upper bound of a pixel's shot-noise rate in the dark, relative to the nominal rate of one polarity."""


class Firing(NamedTuple):
    """Pixels that fire in a step, and scratch to find and list them."""

    entries: np.ndarray  # int32 [h * w + 1, 4], a row per pixel: PIXEL, PLACE, CROSSED, ACCEPTED
    order: np.ndarray  # int32, working memory: indices of the entries with events left
    words: np.ndarray  # uint64, flags of a strip
    candidates: np.ndarray  # int32 [2, pixels of a strip + SPARE], scratch


def initial(height: int, width: int, physics: Physics, key: np.uint64, channel: int) -> Pixels:
    """State of the pixels before the first frame, with the thresholds and leak rates drawn for this channel."""
    n = height * width
    real = np.float64 if physics.cutoff_hz > 0 or physics.source_follower_hz > 0 else np.float32
    threshold_on, threshold_off, leak_factor = mismatch(physics, n, key, channel)
    photoreceptor = np.zeros(n if physics.source_follower_hz > 0 else 0)
    since = np.full(n, -physics.refractory_s, np.float32)
    return Pixels(np.zeros(n, real), np.zeros(n, real), photoreceptor, threshold_on, threshold_off, leak_factor, since)


@borrowing
def _respond(light, frame, y, w, dn, linlog):
    intensity_rows(light, frame, y, w, dn)
    if light.images.itemsize == 1 or light.top.size:  # bytes, or a scene that an 8-bit video shows
        linlog_8bit(dn, linlog)
    else:
        linlog_as_v2e(dn, linlog)


@compiled
def start(light, pixels, steps):
    """Set low-pass and memory to the first frame; nothing fires."""
    dn, linlog = np.empty(pixels.memory.size, np.float32), np.empty(pixels.memory.size, np.float32)
    _respond(light, ZERO, ZERO, steps.width, dn, linlog)
    pixels.filtered[:] = pixels.memory[:] = linlog
    if pixels.photoreceptor.size:
        pixels.photoreceptor[:] = linlog


@compiled
def advance(light, pixels, steps, columns):
    """Advance the pixels through `steps`, in place; return the columns with the events, and the number of events."""
    physics, times_us, h, w = steps.physics, steps.times_us, steps.height, steps.width
    rows = rows_of_strip(h, w)
    strip = np.empty((3, rows * w), np.float32)
    entries, order = np.empty((h * w + 1, 4), np.int32), np.empty(h * w + 1, np.int32)
    firing = Firing(entries, order, flag_words(rows * w), np.empty((2, rows * w + SPARE), np.int32))
    leak_key = key_for(steps.key, randomness.LEAK_JITTER, steps.channel)
    shot_key = key_for(steps.key, randomness.SHOT_NOISE, steps.channel)
    max_share = physics.threshold_on / pixels.threshold_on.min() + physics.threshold_off / pixels.threshold_off.min()
    used = ZERO
    for k in range(times_us.size - 1):
        number = steps.first_number + k
        dt = (times_us[k + 1] - times_us[k]) * 1e-6
        keys = mixed(leak_key, number), mixed(shot_key, number)
        step = Step(physics, times_us[k], times_us[k + 1], dt, keys[0], keys[1], max_share)
        n, most = ZERO, ZERO
        for y in range(0, h, rows):
            first, stop = y * w, min(y + rows, h) * w
            dn, linlog, noise = strip[0, : stop - first], strip[1, : stop - first], strip[2, : stop - first]
            filtered, memory = pixels.filtered[first:stop], pixels.memory[first:stop]
            threshold_on, threshold_off = pixels.threshold_on[first:stop], pixels.threshold_off[first:stop]
            _respond(light, steps.first_frame + k, y, w, dn, linlog)
            if physics.source_follower_hz > 0:
                photoreceptor = pixels.photoreceptor[first:stop]
                if physics.cutoff_hz > 0:
                    _filter(linlog, dn, photoreceptor, 2 * math.pi * physics.cutoff_hz * dt)
                else:
                    photoreceptor[:] = linlog
                _buffer(photoreceptor, filtered, min(1.0, 2 * math.pi * physics.source_follower_hz * dt))
            elif physics.cutoff_hz > 0:
                _filter(linlog, dn, filtered, 2 * math.pi * physics.cutoff_hz * dt)
            else:
                filtered[:] = linlog
            if physics.leak_rate_hz > 0:
                rough_normals(step.leak_key, first, noise)
                _leak(memory, threshold_on, pixels.leak_factor[first:stop], noise, dt, physics)
            _flag(filtered, memory, threshold_on, threshold_off, flags_of(firing.words, stop - first))
            n, most = _count(pixels, steps, y, stop, firing, n, most)
        before = used
        columns, used = _emit(pixels, step, firing, n, most, columns, used)
        if dt < 1e-6 * most:
            sort_ties(columns, before, used)
        if physics.shot_noise_rate_hz > 0:
            columns, used = _emit_shots(light, steps.first_frame + k, pixels, step, w, columns, used)
    return columns, used


@borrowing
def _filter(linlog, dn, filtered, rate):
    """First-order low-pass whose bandwidth grows with light: rate = 2 pi cutoff dt at full brightness."""
    per_dn = rate / SATURATION
    for j in range(dn.size):
        share = min(1.0, (np.float64(dn[j]) + DARK_OFFSET) * per_dn)
        filtered[j] += share * (linlog[j] - filtered[j])


@borrowing
def _buffer(photoreceptor, filtered, share):
    """The source follower: a first-order low-pass that closes `share` of the difference in a step."""
    for j in range(filtered.size):
        filtered[j] += share * (photoreceptor[j] - filtered[j])


@borrowing
def _leak(memory, threshold_on, leak_factor, noise, dt, physics):
    """Lower each memory by the leak of the reset switch, which makes a dark, motionless scene fire ON events."""
    one, dt = np.float32(1), np.float32(dt)
    rate, jitter = np.float32(physics.leak_rate_hz), np.float32(physics.leak_jitter)
    for j in range(memory.size):
        memory[j] -= dt * (rate * leak_factor[j] * (one - jitter * noise[j])) * threshold_on[j]


@borrowing
def _flag(filtered, memory, threshold_on, threshold_off, fires):
    for j in range(filtered.size):
        change = (filtered[j] - memory[j]) * NEARLY
        fires[j] = (change >= threshold_on[j]) | (-change >= threshold_off[j])


@borrowing
def _count(pixels, steps, y, stop, firing, n, most):
    """List the flagged pixels from row y up to pixel `stop`, with their threshold crossings (negative for OFF).

    `n` is the length of the list, `most` the largest number of crossings so far; returns both.
    """
    physics, w, first = steps.physics, steps.width, y * steps.width
    filtered, memory = pixels.filtered[first:stop], pixels.memory[first:stop]
    threshold_on, threshold_off = pixels.threshold_on[first:stop], pixels.threshold_off[first:stop]
    entries, candidates = firing.entries, firing.candidates
    count = flagged(firing.words, stop - first, candidates[0], candidates[1])
    row_end = w
    double = memory.itemsize == 8  # v2e divides float64 by a Python float where all pixels have one threshold
    for c in range(count):
        j = np.uint64(candidates[0, c])  # unsigned: numba checks other indices for being negative
        while candidates[0, c] >= row_end:
            y, row_end = y + 1, row_end + w
        change = np.float64(filtered[j] - memory[j])
        on, off = np.float64(threshold_on[j]), np.float64(threshold_off[j])
        if double and physics.threshold_sigma_on == 0:
            on = physics.threshold_on
        if double and physics.threshold_sigma_off == 0:
            off = physics.threshold_off
        crossed = np.int32(change / (on if change > 0 else off))
        entry = np.uint64(n)
        entries[entry, PIXEL], entries[entry, CROSSED], entries[entry, ACCEPTED] = first + candidates[0, c], crossed, 0
        entries[entry, PLACE] = y << 16 | (candidates[0, c] - row_end + w)
        n += crossed != 0
        most = max(most, abs(crossed))
    return n, most


@compiled
def _emit(pixels, step, firing, n, most, columns, used):
    """Append the events of one step, slot by slot: the busiest pixel of the channel sets the number of slots for all.

    An event within the refractory period of its pixel is suppressed; its change of light can fire in the next step.
    """
    physics, start_us, stop_us = step.physics, step.start_us, step.stop_us
    order = firing.order
    refractory = physics.refractory_s > (stop_us - start_us) * 1e-6 / max(most, 1)
    least = np.float32(physics.refractory_s) if refractory else np.float32(-np.inf)
    first = np.float32((start_us + (stop_us - start_us) / max(most, 1)) * 1e-6)
    last = np.float32(stop_us * 1e-6)
    interval = np.float32((last - first) / np.float32(max(most - 1, 1)))
    for a in range(n):
        order[a] = a
    active = n
    for number in range(1, most + 1):
        t_us = np.int64(np.rint(start_us + (stop_us - start_us) * number / most))
        # torch.linspace, which v2e calls, counts from both ends
        early = number <= most // 2
        stamp = first + interval * np.float32(number - 1) if early else last - interval * np.float32(most - number)
        columns = with_room(columns, used, active + 1)
        written, active = _emit_slot(pixels, firing, active, number, t_us, stamp, least, columns, used)
        used += written
    _consume(pixels, firing.entries, n)
    return columns, used


@borrowing
def _emit_slot(pixels, firing, active, number, t_us, stamp, least, columns, used):
    """Append the events of slot `number` (from 1) at `t_us`; returns their number, and of pixels with events left.

    `stamp` is the same time in seconds. Pixels fire if it exceeds their last event's by more than `least`, -infinity if
    the refractory period cannot suppress an event. The columns have room for one event more than active pixels.
    """
    refractory = least >= np.float32(0)
    entries, order, since = firing.entries, firing.order, pixels.refractory_since
    t, x, y, p = columns.t[used:], columns.x[used:], columns.y[used:], columns.p[used:]
    written, remaining = 0, 0
    for a in range(active):  # without branches: an event that is suppressed is overwritten by the next
        e, at = np.uint64(order[a]), np.uint64(written)
        i, place, crossed = np.uint64(entries[e, PIXEL]), entries[e, PLACE], entries[e, CROSSED]
        accepted = np.float32(stamp - since[i]) > least
        if refractory:
            since[i] = stamp if accepted else since[i]
        polarity = np.int32(1) if crossed > 0 else np.int32(-1)
        t[at], x[at], y[at], p[at] = t_us, place & 0xFFFF, place >> 16, polarity
        entries[e, ACCEPTED] += polarity if accepted else np.int32(0)
        written += int(accepted)
        order[np.uint64(remaining)] = e
        remaining += abs(crossed) > number
    return written, remaining


@borrowing
def _consume(pixels, entries, n):
    """Move each memory by the thresholds whose events were accepted; the remainder of the change is kept."""
    for a in range(n):
        i, accepted = np.uint64(entries[a, PIXEL]), entries[a, ACCEPTED]
        on, off = pixels.threshold_on[i], pixels.threshold_off[i]
        pixels.memory[i] += (on if accepted > 0 else off) * np.float32(accepted)


@compiled
def _emit_shots(light, frame, pixels, step, w, columns, used):
    """Append the shot noise of one step: each pixel fires with a small probability that falls with light.

    Geometric skipping finds the pixels that would fire in the dark at the channel's lowest thresholds. The draw
    at the pixel's own light and thresholds then keeps a part of them.
    """
    physics, key, pixel_count = step.physics, step.shot_key, pixels.memory.size
    half_rate = physics.shot_noise_rate_hz / 2 * step.duration_s
    ceiling = min(step.max_shot_share * half_rate, 1.0)
    dn = np.empty(w, np.float32)
    before, row, i, draw = used, -1, -1, 0
    while True:
        gap = math.log(uniform(mixed(key, draw))) / math.log1p(-ceiling) if ceiling < 1 else 0.0
        if gap >= pixel_count - 1 - i:
            break
        i += 1 + int(gap)
        if i // w != row:
            row = i // w
            intensity_rows(light, frame, row, w, dn)
        chance = half_rate * shot_noise_fraction(dn[i - row * w])
        on = chance * physics.threshold_on / pixels.threshold_on[i]
        off = chance * physics.threshold_off / pixels.threshold_off[i]
        u = uniform(mixed(key, draw + 1)) * ceiling
        draw += 2
        if u >= on + off:
            continue
        columns = with_room(columns, used, ONE)
        columns.t[used], columns.x[used], columns.y[used] = np.int64(np.rint(step.stop_us)), i - row * w, row
        columns.p[used] = 1 if u < on else -1
        pixels.memory[i] = pixels.filtered[i]
        used += 1
    sort_ties(columns, first_tied(columns, before, used), used)
    return columns, used
