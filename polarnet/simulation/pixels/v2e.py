"""The pixel model `v2e` (Hu, Liu, Delbruck, CVPRW 2021): the same events as the published code.

Precision is part of the model, since 8-bit light meets thresholds exactly. The state is float32, or float64 with the
photoreceptor's low-pass; thresholds times counts are float32; stamps within a step are float32 seconds.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import ZERO, borrowing, compiled
from polarnet.simulation.pixels import physics, randomness
from polarnet.simulation.pixels.active import SPARE, flag_words, flagged, flags_of, rows_of_strip
from polarnet.simulation.pixels.columns import event_of, place_of, roomier, write_in_order
from polarnet.simulation.pixels.light import intensity_rows, respond_8bit, respond_as_v2e, table_of_response
from polarnet.simulation.pixels.physics import DARK_OFFSET, SATURATION, Physics, mismatch, shot_noise_fraction, wander
from polarnet.simulation.pixels.randomness import key_for, mixed, rough_normals, uniform

EIGHT_BIT_VIDEO = True
OPTIONS: tuple[str, ...] = ("dark_dn", "photoreceptor_noise")
NEARLY = np.float32(1.000001)  # enlarges changes by more than rounding in a first test; `_count` then counts exactly

physics_of = physics.physics_of


class Pixels(NamedTuple):
    """State of one channel, one array [h * w] per quantity; float32 unless stated."""

    memory: np.ndarray  # log intensity at the last event, less what leaked; float64 with a low-pass
    filtered: np.ndarray
    """Log intensity behind the low-passes of photoreceptor and source follower; float64 with a low-pass."""
    photoreceptor: np.ndarray  # float64, log intensity between the two; empty without a source follower
    noise: np.ndarray  # of the photoreceptor, natural-log intensity; empty without it
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


def initial(height: int, width: int, physics: Physics, key: np.uint64, channel: int) -> Pixels:
    """State of the pixels before the first frame, with the thresholds and leak rates drawn for this channel."""
    n = height * width
    real = np.float64 if physics.cutoff_hz > 0 or physics.source_follower_hz > 0 else np.float32
    threshold_on, threshold_off, leak_factor = mismatch(physics, n, key, channel)
    photoreceptor = np.zeros(n if physics.source_follower_hz > 0 else 0)
    since = np.full(n, -physics.refractory_s, np.float32)
    noise = np.zeros(n if physics.photoreceptor_noise > 0 else 0, np.float32)
    memory, filtered = np.zeros((2, n), real)
    return Pixels(memory, filtered, photoreceptor, noise, threshold_on, threshold_off, leak_factor, since)


@borrowing
def _respond(light, frame, y, w, physics, table, dn, response):
    intensity_rows(light, frame, y, w, dn)
    if light.images.itemsize == 1 or (light.top.size and physics.dark_dn == 0):  # a scene that an 8-bit video shows
        respond_8bit(dn, table, response)
    else:
        respond_as_v2e(dn, physics, response)


@compiled
def start(light, pixels, steps):
    """Set low-pass and memory to the first frame; nothing fires."""
    dn, response = np.empty(pixels.memory.size, np.float32), np.empty(pixels.memory.size, np.float32)
    _respond(light, ZERO, ZERO, steps.width, steps.physics, table_of_response(steps.physics), dn, response)
    pixels.filtered[:] = pixels.memory[:] = response
    if pixels.photoreceptor.size:
        pixels.photoreceptor[:] = response
    pixels.refractory_since[:] += np.float32(min(steps.times_us[0], 0.0) * 1e-6)


@compiled
def advance(light, pixels, steps, columns):
    """Advance the pixels through `steps`, in place; return the columns with the events, and the number of events."""
    physics, times_us, w, size = steps.physics, steps.times_us, steps.width, steps.height * steps.width
    (dn, response), noise = np.empty((2, w), np.float32), np.empty(size, np.float32)
    table, words, (candidates, groups) = table_of_response(physics), flag_words(w), np.empty((2, w + SPARE), np.int32)
    firing, crossed = np.empty((2, size + 1), np.int32)
    pending = np.empty(size, np.int64)
    leak_key = key_for(steps.key, randomness.LEAK_JITTER, steps.channel)
    shot_key = key_for(steps.key, randomness.SHOT_NOISE, steps.channel)
    noise_key = key_for(steps.key, randomness.PHOTORECEPTOR, steps.channel)
    output = np.empty_like(pixels.filtered) if physics.photoreceptor_noise > 0 else pixels.filtered
    max_share = physics.threshold_on / pixels.threshold_on.min() + physics.threshold_off / pixels.threshold_off.min()
    used = ZERO
    for k in range(times_us.size - 1):
        number, frame = steps.first_number + k, steps.first_frame + k
        dt = (times_us[k + 1] - times_us[k]) * 1e-6
        keys = mixed(leak_key, number), mixed(shot_key, number)
        step = Step(physics, times_us[k], times_us[k + 1], dt, keys[0], keys[1], max_share)
        if physics.leak_rate_hz > 0:
            strip = rows_of_strip(steps.height, w) * w  # each with numbers of its own
            for first in range(0, size, strip):
                rough_normals(step.leak_key, first, noise[first : first + strip])
        n, most = ZERO, ZERO
        for y in range(steps.height):
            row = slice(y * w, (y + 1) * w)
            filtered, memory = pixels.filtered[row], pixels.memory[row]
            _respond(light, frame, y, w, physics, table, dn, response)
            if physics.source_follower_hz > 0:
                photoreceptor = pixels.photoreceptor[row]
                if physics.cutoff_hz > 0:
                    _filter(response, dn, photoreceptor, 2 * math.pi * physics.cutoff_hz * dt)
                else:
                    photoreceptor[:] = response
                _buffer(photoreceptor, filtered, min(1.0, 2 * math.pi * physics.source_follower_hz * dt))
            elif physics.cutoff_hz > 0:
                _filter(response, dn, filtered, 2 * math.pi * physics.cutoff_hz * dt)
            else:
                filtered[:] = response
            if physics.photoreceptor_noise > 0:
                wander(pixels.noise[row], mixed(noise_key, number), y * w, physics, dt, response)
                output[row] = filtered + pixels.noise[row]
            if physics.leak_rate_hz > 0:
                _leak(memory, pixels.threshold_on[row], pixels.leak_factor[row], noise[row], dt, physics)
            _flag(output[row], memory, pixels.threshold_on[row], pixels.threshold_off[row], flags_of(words, w))
            count = flagged(words, w, candidates, groups)
            n, most = _count(pixels, output, physics, y * w, candidates[:count], firing, crossed, n, most)
        pending, n = _emit(pixels, step, w, firing[:n], crossed, most, pending)
        if physics.shot_noise_rate_hz > 0:
            pending, n = _emit_shots(light, frame, pixels, output, step, w, pending, n)
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
def _count(pixels, output, physics, first, candidates, firing, crossed, n, most):
    """List the candidates of the row from pixel `first` on that cross thresholds, and how many (negative for OFF).

    `n` is the length of the list, `most` the largest number of crossings so far; returns both.
    """
    double = pixels.memory.itemsize == 8  # v2e divides float64 by a Python float where all pixels have one threshold
    for x in candidates:
        i = first + x
        change = np.float64(output[i] - pixels.memory[i])
        on, off = np.float64(pixels.threshold_on[i]), np.float64(pixels.threshold_off[i])
        if double and physics.threshold_sigma_on == 0 and physics.threshold_mismatch_on == 0:
            on = physics.threshold_on
        if double and physics.threshold_sigma_off == 0 and physics.threshold_mismatch_off == 0:
            off = physics.threshold_off
        firing[n], crossed[n] = i, np.int32(change / (on if change > 0 else off))
        most = max(most, abs(crossed[n]))
        n += crossed[n] != 0
    return n, most


@compiled
def _emit(pixels, step, width, firing, crossed, most, pending):
    """Pending events of one step and their number: the busiest pixel of the channel sets the number of slots for all.

    An event within the refractory period of its pixel is suppressed; its change of light can fire in the next step.
    """
    start_us, stop_us, refractory_s = step.start_us, step.stop_us, step.physics.refractory_s
    least = np.float32(refractory_s) if refractory_s > (stop_us - start_us) * 1e-6 / max(most, 1) else np.float32(-1)
    offsets_us, stamps = _slots(start_us, stop_us, most)
    n = 0
    for a in range(firing.size):
        i, on, accepted = firing[a], crossed[a] > 0, 0
        place = place_of(i // width, i % width)
        while n + abs(crossed[a]) > pending.size:
            pending = roomier(pending)
        for slot in range(abs(crossed[a])):
            if least < 0 or np.float32(stamps[slot] - pixels.refractory_since[i]) > least:
                pending[n] = event_of(offsets_us[slot], place, on)
                n, accepted = n + 1, accepted + 1
                if least >= 0:
                    pixels.refractory_since[i] = stamps[slot]
        # the remainder of the change is kept
        threshold = pixels.threshold_on[i] if on else -pixels.threshold_off[i]
        pixels.memory[i] += threshold * np.float32(accepted)
    return pending, n


@compiled
def _slots(start_us, stop_us, most):
    """Times of a step's slots in whole microseconds since its start, and in seconds as v2e's float32 stamps."""
    offsets_us, stamps = np.empty(most, np.int64), np.empty(most, np.float32)
    first = np.float32((start_us + (stop_us - start_us) / max(most, 1)) * 1e-6)
    last = np.float32(stop_us * 1e-6)
    interval = np.float32((last - first) / np.float32(max(most - 1, 1)))
    for slot in range(most):
        time_us = start_us + (stop_us - start_us) * (slot + 1) / most
        offsets_us[slot] = np.int64(np.rint(time_us)) - np.int64(math.floor(start_us))
        # torch.linspace, which v2e calls, counts from both ends
        early = slot < most // 2
        stamps[slot] = first + interval * np.float32(slot) if early else last - interval * np.float32(most - 1 - slot)
    return offsets_us, stamps


@compiled
def _emit_shots(light, frame, pixels, output, step, w, pending, n):
    """Append the shot noise of one step to the n pending events: each pixel's probability to fire falls with light.

    Geometric skipping finds the pixels that would fire in the dark at the channel's lowest thresholds. The draw
    at the pixel's own light and thresholds then keeps a part of them.
    """
    physics, key, pixel_count = step.physics, step.shot_key, pixels.memory.size
    half_rate = physics.shot_noise_rate_hz / 2 * step.duration_s
    ceiling = min(step.max_shot_share * half_rate, 1.0)
    dn = np.empty(w, np.float32)
    row, i, draw = -1, -1, 0
    offset_us = np.int64(np.rint(step.stop_us)) - np.int64(math.floor(step.start_us))
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
        if n == pending.size:
            pending = roomier(pending)
        pending[n] = event_of(offset_us, place_of(row, i - row * w), u < on)
        pixels.memory[i] = output[i]
        n += 1
    return pending, n
