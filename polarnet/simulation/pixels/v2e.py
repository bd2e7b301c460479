"""The pixel model `v2e` (Hu, Liu, Delbruck, CVPRW 2021): the same events as the published code.

Precision is part of the model, since 8-bit light meets thresholds exactly. The state is float32, or float64 with the
photoreceptor's low-pass; thresholds times counts are float32; stamps within a step are float32 seconds.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.runtime.compilation import ZERO, borrowing, compiled
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.active import SPARE, flag_words, flagged, flags_of, rows_of_strip
from polarnet.simulation.pixels.columns import Steps, event_of, pixel_place, roomier, write_in_order
from polarnet.simulation.pixels.light import Light, intensity_rows, respond_8bit, respond_as_v2e, table_of_response
from polarnet.simulation.pixels.physics import DARK_OFFSET, SATURATION, mismatch, shot_noise_fraction, wander
from polarnet.simulation.pixels.randomness import key_for, mixed, rough_normals, uniform

EIGHT_BIT_VIDEO = True
NEARLY = np.float32(1.000001)  # enlarges changes by more than rounding in a first test; `_count` then counts exactly
PIXEL, EVENT, CROSSED, ACCEPTED = range(4)
"""Columns of the list of firing pixels: index, place and polarity as `columns.event_of` encodes them, crossed
thresholds and accepted events, the last two negative for OFF."""


class Pixels(NamedTuple):
    """State of one channel, one array [h * w] per quantity; float32 unless stated."""

    memory: np.ndarray  # log intensity at the last event, less what leaked; float64 with a low-pass
    filtered: np.ndarray  # log intensity behind the low-pass of the photoreceptor; float64 with a low-pass
    noise: np.ndarray  # of the photoreceptor, natural-log intensity; empty without it
    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak_factor: np.ndarray  # leak rate relative to the nominal rate, frozen per pixel
    refractory_since: np.ndarray  # time in seconds of the last event that started a refractory period


class Firing(NamedTuple):
    """Pixels that fire in a step, scratch to find and list them, and values that hold for all steps."""

    output: np.ndarray  # of the photoreceptor, noise included, natural-log intensity [h * w]
    max_shot_share: float
    """Upper bound of a pixel's shot-noise rate in the dark, relative to the nominal rate of one polarity."""
    entries: np.ndarray  # int32 [h * w + 1, 4], a row per pixel: PIXEL, EVENT, CROSSED, ACCEPTED
    order: np.ndarray  # int32, working memory: indices of the entries with events left
    words: np.ndarray  # uint64, flags of a strip
    candidates: np.ndarray  # int32 [2, pixels of a strip + SPARE], scratch


class Slot(NamedTuple):
    """One of the times at which pixels fire within a step."""

    number: int  # from 1
    event: np.int64  # its time, as `columns.event_of` encodes it
    stamp: np.float32  # the same time in seconds
    least_s: np.float32  # a pixel fires if its last event is longer ago; -infinity if none can be suppressed


def start(light: Light, steps: Steps) -> Pixels:
    """Pixels with low-pass and memory at the first frame, and the thresholds and leak rates drawn for this channel."""
    physics, n = steps.physics, steps.height * steps.width
    threshold_on, threshold_off, leak_factor = mismatch(physics, n, steps.key, steps.channel)
    dn, response = np.empty((2, n), np.float32)
    _respond(light, steps, ZERO, ZERO, table_of_response(physics), dn, response)
    memory = response.astype(np.float64 if physics.cutoff_hz > 0 else np.float32)
    noise = np.zeros(n if physics.photoreceptor_noise > 0 else 0, np.float32)
    since = np.full(n, -physics.refractory_s, np.float32) + np.float32(min(steps.times_us[0], 0.0) * 1e-6)
    return Pixels(memory, memory.copy(), noise, threshold_on, threshold_off, leak_factor, since)


@borrowing
def _respond(light, steps, frame, y, table, dn, response):
    intensity_rows(light, frame, y, steps.width, dn)
    if light.images.itemsize == 1 or (light.top.size and steps.physics.dark_dn == 0):
        respond_8bit(dn, table, response)  # bytes, or a scene that an 8-bit video shows
    else:
        respond_as_v2e(dn, steps.physics, response)


@compiled
def advance(light, pixels, steps, columns):
    """Advance the pixels through `steps`, in place; return the columns with the events, and the number of events."""
    physics, times_us, h, w = steps.physics, steps.times_us, steps.height, steps.width
    rows = rows_of_strip(h, w)
    strip, table = np.empty((3, rows * w), np.float32), table_of_response(physics)
    entries, order = np.empty((h * w + 1, 4), np.int32), np.empty(h * w + 1, np.int32)
    pending = np.empty(h * w, np.int64)
    leak_key = key_for(steps.key, randomness.LEAK_JITTER, steps.channel)
    noise_key = key_for(steps.key, randomness.PHOTORECEPTOR, steps.channel)
    output = np.empty_like(pixels.filtered) if physics.photoreceptor_noise > 0 else pixels.filtered
    max_share = physics.threshold_on / pixels.threshold_on.min() + physics.threshold_off / pixels.threshold_off.min()
    candidates = np.empty((2, rows * w + SPARE), np.int32)
    firing = Firing(output, max_share, entries, order, flag_words(rows * w), candidates)
    used = ZERO
    for k in range(times_us.size - 1):
        number, frame, dt = steps.first_number + k, steps.first_frame + k, (times_us[k + 1] - times_us[k]) * 1e-6
        count = ZERO
        for y in range(0, h, rows):
            first, stop = y * w, min(y + rows, h) * w
            part = slice(first, stop)
            dn, response, noise = strip[0, : stop - first], strip[1, : stop - first], strip[2, : stop - first]
            filtered, memory, threshold_on = pixels.filtered[part], pixels.memory[part], pixels.threshold_on[part]
            _respond(light, steps, frame, y, table, dn, response)
            if physics.cutoff_hz > 0:
                _filter(response, dn, filtered, 2 * math.pi * physics.cutoff_hz * dt)
            else:
                filtered[:] = response
            if physics.photoreceptor_noise > 0:
                wander(pixels.noise[part], mixed(noise_key, number), first, physics, dt, response)
                output[part] = filtered + pixels.noise[part]
            if physics.leak_rate_hz > 0:
                rough_normals(mixed(leak_key, number), first, noise)
                _leak(memory, threshold_on, pixels.leak_factor[part], noise, dt, physics)
            _flag(output[part], memory, threshold_on, pixels.threshold_off[part], flags_of(firing.words, stop - first))
            count = _count(pixels, steps, first, stop, firing, count)
        pending, n = _emit(pixels, steps, k, firing, count, pending)
        if physics.shot_noise_rate_hz > 0:
            pending, n = _emit_shots(light, pixels, firing, steps, k, pending, n)
        columns, used = write_in_order(steps, k, pending, n, columns, used)
    return columns, used


@borrowing
def _filter(response, dn, filtered, rate):
    """First-order low-pass whose bandwidth grows with light: rate = 2 pi cutoff dt at full brightness."""
    per_dn = rate / SATURATION
    for j in range(dn.size):
        share = min(1.0, (np.float64(dn[j]) + DARK_OFFSET) * per_dn)
        filtered[j] += share * (response[j] - filtered[j])


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
def _count(pixels, steps, first, stop, firing, n):
    """Append the flagged pixels from `first` up to `stop` that cross a threshold to the n listed ones; returns n."""
    physics, entries, candidates = steps.physics, firing.entries, firing.candidates
    count = flagged(firing.words, stop - first, candidates[0], candidates[1])
    double = pixels.memory.itemsize == 8  # v2e divides float64 by a Python float where all pixels have one threshold
    for c in range(count):
        i, entry = np.uint64(first + candidates[0, c]), np.uint64(n)  # unsigned: numba checks others for being negative
        change = np.float64(firing.output[i] - pixels.memory[i])
        on, off = np.float64(pixels.threshold_on[i]), np.float64(pixels.threshold_off[i])
        if double and physics.threshold_sigma_on == 0 and physics.threshold_mismatch_on == 0:
            on = physics.threshold_on
        if double and physics.threshold_sigma_off == 0 and physics.threshold_mismatch_off == 0:
            off = physics.threshold_off
        crossed = np.int32(change / (on if change > 0 else off))
        event = pixel_place(first + candidates[0, c], steps.width) | np.int64(crossed > 0)
        entries[entry, PIXEL], entries[entry, EVENT] = i, event
        entries[entry, CROSSED], entries[entry, ACCEPTED] = crossed, 0
        n += crossed != 0
    return n


@compiled
def _emit(pixels, steps, k, firing, count, pending):
    """Pending events of one step in the order of its slots, and their number.

    The busiest pixel of the channel sets the number of slots for all. An event within the refractory period of its
    pixel is suppressed; its change of light can fire in the next step.
    """
    physics, start_us, stop_us, most = steps.physics, steps.times_us[k], steps.times_us[k + 1], 0
    for a in range(count):
        most, firing.order[a] = max(most, abs(firing.entries[a, CROSSED])), a
    refractory = physics.refractory_s > (stop_us - start_us) * 1e-6 / max(most, 1)
    least_s = np.float32(physics.refractory_s) if refractory else np.float32(-np.inf)
    first = np.float32((start_us + (stop_us - start_us) / max(most, 1)) * 1e-6)
    last = np.float32(stop_us * 1e-6)
    interval = np.float32((last - first) / np.float32(max(most - 1, 1)))
    n, active = ZERO, np.int64(count)
    for number in range(1, most + 1):
        offset_us = np.int64(np.rint(start_us + (stop_us - start_us) * number / most)) - np.int64(math.floor(start_us))
        # torch.linspace, which v2e calls, counts from both ends
        early = number <= most // 2
        stamp = first + interval * np.float32(number - 1) if early else last - interval * np.float32(most - number)
        while n + active >= pending.size:
            pending = roomier(pending)
        written, active = _emit_slot(
            pixels, firing, active, Slot(number, event_of(offset_us, 0, 0), stamp, least_s), pending[n:]
        )
        n += written
    _consume(pixels, firing.entries, count)
    return pending, n


@borrowing
def _emit_slot(pixels, firing, active, slot, pending):
    """Write the events of a slot into `pending`; returns their number, and that of pixels with events left.

    There is room for one event more than active pixels.
    """
    refractory = slot.least_s >= np.float32(0)
    entries, order, since = firing.entries, firing.order, pixels.refractory_since
    written, remaining = 0, 0
    for a in range(active):  # without branches: an event that is suppressed is overwritten by the next
        e = np.uint64(order[a])
        i, crossed = np.uint64(entries[e, PIXEL]), entries[e, CROSSED]
        accepted = np.float32(slot.stamp - since[i]) > slot.least_s
        if refractory:
            since[i] = slot.stamp if accepted else since[i]
        pending[np.uint64(written)] = slot.event | entries[e, EVENT]
        polarity = np.int32(1) if crossed > 0 else np.int32(-1)
        entries[e, ACCEPTED] += polarity if accepted else np.int32(0)
        written += int(accepted)
        order[np.uint64(remaining)] = e
        remaining += abs(crossed) > slot.number
    return written, remaining


@borrowing
def _consume(pixels, entries, count):
    """Move each memory by the thresholds whose events were accepted; the remainder of the change is kept."""
    for a in range(count):
        i, accepted = np.uint64(entries[a, PIXEL]), entries[a, ACCEPTED]
        on, off = pixels.threshold_on[i], pixels.threshold_off[i]
        pixels.memory[i] += (on if accepted > 0 else off) * np.float32(accepted)


@compiled
def _emit_shots(light, pixels, firing, steps, k, pending, n):
    """Append the shot noise of step k to the n pending events: each pixel's probability to fire falls with light.

    Geometric skipping finds the pixels that would fire in the dark at the channel's lowest thresholds. The draw
    at the pixel's own light and thresholds then keeps a part of them.
    """
    physics, w, start_us, stop_us = steps.physics, steps.width, steps.times_us[k], steps.times_us[k + 1]
    key = mixed(key_for(steps.key, randomness.SHOT_NOISE, steps.channel), steps.first_number + k)
    half_rate = physics.shot_noise_rate_hz / 2 * ((stop_us - start_us) * 1e-6)
    ceiling = min(firing.max_shot_share * half_rate, 1.0)
    dn = np.empty(w, np.float32)
    row, i, draw = -1, -1, 0
    offset_us = np.int64(np.rint(stop_us)) - np.int64(math.floor(start_us))
    while True:
        gap = math.log(uniform(mixed(key, draw))) / math.log1p(-ceiling) if ceiling < 1 else 0.0
        if gap >= pixels.memory.size - 1 - i:
            break
        i += 1 + int(gap)
        if i // w != row:
            row = i // w
            intensity_rows(light, steps.first_frame + k, row, w, dn)
        chance = half_rate * shot_noise_fraction(dn[i - row * w])
        on = chance * physics.threshold_on / pixels.threshold_on[i]
        off = chance * physics.threshold_off / pixels.threshold_off[i]
        u = uniform(mixed(key, draw + 1)) * ceiling
        draw += 2
        if u >= on + off:
            continue
        if n == pending.size:
            pending = roomier(pending)
        pending[n] = event_of(offset_us, pixel_place(i, w), u < on)
        pixels.memory[i] = firing.output[i]
        n += 1
    return pending, n
