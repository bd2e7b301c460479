"""Passes over pixels compiled by numba: the network's elementwise parts, for inference on a processor.

The torch functions named in the docstrings are the definitions, used for training, on GPUs and for ONNX;
`compiled_path` decides. Most kernels handle one window of one stream. Threads share strips of rows, and the sums of a
strip do not depend on the number of threads. Arrays are float32 and contiguous; kernels take them as tensors, too.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from numba import prange
from torch import Tensor

from polarnet.runtime.compilation import compiled, inlined, parallel

F32 = np.float32
SIDE = 4  # pixels of a block along each axis
TILE = 64  # pixels of a row that are processed together, in fast memory
SQRT_HALF_BITS = np.int32(0x3F3504F3)
FAST = {"contract", "nnan", "nsz"}  # which vectors need, and which keep the order of sums


def compiled_path(x: Tensor) -> bool:
    """Return whether kernels may process `x`: float32 on a processor, without gradients, and not while tracing."""
    plain = x.device.type == "cpu" and x.dtype == torch.float32
    return plain and not torch.is_grad_enabled() and not torch.compiler.is_compiling()


_row = functools.partial(compiled, fastmath=FAST)


def _strips(kernel: Callable) -> Any:
    run = parallel(kernel, fastmath=FAST)
    return lambda *arguments: run(*(x.numpy() if isinstance(x, Tensor) else x for x in arguments))


@_row
def _compress(values, image, half):
    """Write `blocks.compressed` of a row into an image of float32, or of bfloat16 as uint16."""
    for i in range(len(image)):
        bits = F32(F32(1) + abs(values[i])).view(np.int32)
        exponent = (bits - SQRT_HALF_BITS) >> np.int32(23)
        x = np.int32(bits - (exponent << np.int32(23))).view(np.float32) - F32(1)
        series = x * F32(7.0376836292e-2) - F32(1.1514610310e-1)  # Cephes, logf
        series = series * x + F32(1.1676998740e-1)
        series = series * x - F32(1.2420140846e-1)
        series = series * x + F32(1.4249322787e-1)
        series = series * x - F32(1.6668057665e-1)
        series = series * x + F32(2.0000714765e-1)
        series = series * x - F32(2.4999993993e-1)
        series = series * x + F32(3.3333331174e-1)
        log = x + x * x * (x * series - F32(0.5)) + F32(exponent) * F32(math.log(2))
        signed = np.copysign(log, values[i])
        if half:
            word = F32(signed).view(np.uint32)
            image[i] = (word + np.uint32(0x7FFF) + ((word >> np.uint32(16)) & np.uint32(1))) >> np.uint32(16)
        else:
            image[i] = signed


@_row
def _fade(before, now, keep, scale, after, scaled):
    for i in range(len(now)):
        value = keep * before[i] + now[i]
        after[i] = value
        scaled[i] = scale * value


@_row
def _add_scaled(values, factor, sums):
    for i in range(len(values)):
        sums[i] += factor * values[i]


@inlined  # vectors need the constant shape of `b`
def _add_moments(b, activity):
    """Add the products of a row of four channels, b[:4], to the sums b[4:17]; write their contrasts into b[17:21]."""
    for i in range(TILE):
        e0, e45, e90, e135 = b[0, i], b[1, i], b[2, i], b[3, i]
        weight = F32(1) / (F32(1) + activity * (e0 * e0 + e45 * e45 + e90 * e90 + e135 * e135))
        n0, n45, n90, n135 = weight * abs(e0), weight * abs(e45), weight * abs(e90), weight * abs(e135)
        b[4, i] += n0
        b[5, i] += n45
        b[6, i] += n90
        b[7, i] += n135
        b[8, i] += n0 * abs(e0)
        b[9, i] += n45 * abs(e45)
        b[10, i] += n90 * abs(e90)
        b[11, i] += n135 * abs(e135)
        x, y, z = e0 - e90, e45 - e135, (e0 + e90) - (e45 + e135)
        b[12, i] += weight * x * x
        b[13, i] += weight * x * y
        b[14, i] += weight * y * y
        b[15, i] += weight * x * z
        b[16, i] += weight * y * z
        b[17, i] = F32(0.5) * ((e0 + e90) + (e45 + e135))
        b[18, i] = x
        b[19, i] = y
        b[20, i] = z


@_strips
def sums_and_moments(
    before: Float32[np.ndarray, "m 4 h w"],
    polarity: Float32[np.ndarray, "4 h w"],
    count: Float32[np.ndarray, "4 h w"],
    scale,
    keep: Float32[np.ndarray, " m"],
    noise: Float32[np.ndarray, "3 m"],
    half,
    after: Float32[np.ndarray, "m 4 h w"],
    moments: Float32[np.ndarray, "m 6 h/4 w/4"],
    images: Float32[np.ndarray, "4*m+1 h w"],
):
    """Write `redundancy.faded` sums of events, their `SecondMoments`, and `_event_images` of the scaled sums.

    `noise` holds the exponentials of the three parameters of `SecondMoments`.
    """
    width = polarity.shape[2]
    for strip in prange(polarity.shape[1] // SIDE):
        b = np.empty((21, TILE), np.float32)
        for start in range(0, width, TILE):
            stop = min(start + TILE, width)
            for m in range(len(keep)):
                b[:17] = 0
                for y in range(SIDE * strip, SIDE * strip + SIDE):
                    for c in range(4):
                        now = polarity[c, y, start:stop]
                        _fade(before[m, c, y, start:stop], now, keep[m], scale, after[m, c, y, start:stop], b[c])
                    _add_moments(b, noise[0, m])
                    for k in range(4):
                        _compress(b[17 + k], images[4 * m + k, y, start:stop], half)
                for j in range((stop - start) // SIDE):
                    for k in range(4, 17):
                        i = SIDE * j
                        b[k, j] = (b[k, i] + b[k, i + 1] + b[k, i + 2] + b[k, i + 3]) / F32(SIDE * SIDE)
                    for k in range(4):
                        b[k, j] = noise[1, m] * b[8 + k, j] + noise[2, m] * b[4 + k, j]
                    block = moments[m, :, strip, start // SIDE + j]
                    block[0] = b[12, j] - b[0, j] - b[2, j]
                    block[1] = b[13, j]
                    block[2] = b[14, j] - b[1, j] - b[3, j]
                    block[3] = b[15, j] - b[0, j] + b[2, j]
                    block[4] = b[16, j] + b[1, j] - b[3, j]
                    block[5] = b[4, j] + b[5, j] + b[6, j] + b[7, j]
            for y in range(SIDE * strip, SIDE * strip + SIDE):
                b[0] = 0
                for c in range(4):
                    _add_scaled(count[c, y, start:stop], F32(0.5) * scale, b[0])
                _compress(b[0], images[4 * len(keep), y, start:stop], half)


@_row
def _add_events(polarity, count, sign, totals, change, after, weighted):
    for i in range(len(count)):
        after[i] = totals[i] + F32(0.5) * max(count[i] + sign * polarity[i], F32(0))
        weighted[i] += after[i] + after[i] * change[i]


@_strips
def add_events(
    polarity: Float32[np.ndarray, "4 h w"],
    count: Float32[np.ndarray, "4 h w"],
    totals: Float32[np.ndarray, "8 h w"],
    change: Float32[np.ndarray, "8 h w"],
    after: Float32[np.ndarray, "8 h w"],
    blocks: Float32[np.ndarray, "8 h/4 w/4"],
):
    """Write the totals of `Equaliser` after a window, and the block means of the weighted ones."""
    for strip in prange(count.shape[1] // SIDE):
        weighted = np.empty(count.shape[2], np.float32)
        for c in range(8):
            weighted[:] = 0
            sign = F32(1 if c < 4 else -1)
            for y in range(SIDE * strip, SIDE * strip + SIDE):
                _add_events(
                    polarity[c % 4, y], count[c % 4, y], sign, totals[c, y], change[c, y], after[c, y], weighted
                )
            for j in range(blocks.shape[2]):
                i = SIDE * j
                total = weighted[i] + weighted[i + 1] + weighted[i + 2] + weighted[i + 3]
                blocks[c, strip, j] = total / F32(SIDE * SIDE)


@_row
def _enlarge(blocks, y, padded, row):
    """Write row y of `blocks.enlarged(blocks, 4)`; `padded` is room for a row of blocks and one more on either side."""
    above = (y - 2) // SIDE  # -1 in the first rows
    share = F32(((y - 2) % SIDE + 0.5) / SIDE)
    first, second = blocks[max(above, 0)], blocks[min(above + 1, len(blocks) - 1)]
    for j in range(len(first)):
        padded[j + 1] = (F32(1) - share) * first[j] + share * second[j]
    padded[0], padded[len(first) + 1] = padded[1], padded[len(first)]
    for j in range(len(first)):
        left, own, right = padded[j], padded[j + 1], padded[j + 2]
        row[SIDE * j] = F32(0.375) * left + F32(0.625) * own
        row[SIDE * j + 1] = F32(0.125) * left + F32(0.875) * own
        row[SIDE * j + 2] = F32(0.875) * own + F32(0.125) * right
        row[SIDE * j + 3] = F32(0.625) * own + F32(0.375) * right


@_strips
def deviations(
    totals: Float32[np.ndarray, "8 h w"], blocks: Float32[np.ndarray, "8 h/4 w/4"], noise, outlier, sums: np.ndarray
):
    """Sum each channel's power and excess (`Equaliser`) over every second pixel of every second row: [h/4, 8, 2]."""
    for strip in prange(blocks.shape[1]):
        padded, near = np.empty(blocks.shape[2] + 2, np.float32), np.empty(totals.shape[2], np.float32)
        for c in range(8):
            sums[strip, c] = 0
            for y in range(SIDE * strip, SIDE * strip + SIDE, 2):
                _enlarge(blocks[c], y, padded, near)
                power, excess = F32(0), F32(0)
                for i in range(0, len(near), 2):
                    deviation = min(abs(totals[c, y, i] - near[i]), outlier * (near[i] + F32(1)))
                    power += near[i] * near[i]
                    excess += deviation * deviation - noise * near[i]
                sums[strip, c, 0] += power
                sums[strip, c, 1] += excess


@_row
def _weigh(totals, near, prior, limits, change):
    for i in range(len(near)):
        change[i] = min(max((near[i] + prior) / (totals[i] + prior), limits[0]), limits[1]) - F32(1)


@_row
def _weighted(polarity, count, change, balance, sign, polarities, events):
    for i in range(len(count)):
        weighted = F32(0.5) * max(count[i] + sign * polarity[i], F32(0)) * ((change[i] + F32(1)) * balance)
        polarities[i] += sign * weighted
        events[i] += weighted


@_strips
def weigh(
    polarity: Float32[np.ndarray, "4 h w"],
    count: Float32[np.ndarray, "4 h w"],
    totals: Float32[np.ndarray, "8 h w"],
    blocks: Float32[np.ndarray, "8 h/4 w/4"],
    prior: Float32[np.ndarray, " 8"],
    balance: Float32[np.ndarray, " 8"],
    limits: Float32[np.ndarray, " 2"],
    change: Float32[np.ndarray, "8 h w"],
    polarities: Float32[np.ndarray, "4 h w"],
    events: Float32[np.ndarray, "4 h w"],
):
    """Write the weights of `Equaliser` minus 1, and the weighted sum of polarities and number of events."""
    for y in prange(count.shape[1]):
        padded, near = np.empty(blocks.shape[2] + 2, np.float32), np.empty(count.shape[2], np.float32)
        polarities[:, y] = 0
        events[:, y] = 0
        for c in range(8):
            k, sign = c % 4, F32(1 if c < 4 else -1)
            _enlarge(blocks[c], y, padded, near)
            _weigh(totals[c, y], near, prior[c], limits, change[c, y])
            _weighted(polarity[k, y], count[k, y], change[c, y], balance[c], sign, polarities[k, y], events[k, y])


@_strips
def box_means(images: Float32[np.ndarray, "c h w"], side, means: Float32[np.ndarray, "c h w"]):
    """Write `redundancy.box_means` of a width of `side` pixels."""
    channels, height, width = images.shape
    half = side // 2
    for row in prange(channels * height):
        c, y = row // height, row % height
        first, last = max(y - half, 0), min(y + half, height - 1)
        padded, out = np.zeros(width + 2 * half, np.float32), means[c, y]
        for k in range(first, last + 1):
            _add_scaled(images[c, k], F32(1), padded[half : half + width])
        out[:] = 0
        for k in range(side):
            _add_scaled(padded[k : k + width], F32(1), out)
        for x in range(width):
            inside = (last + 1 - first) * (min(x + half, width - 1) + 1 - max(x - half, 0))
            out[x] /= F32(inside)


@_row
def _solve(aa, ab, bb, ac, bc, steps, ridge, least, limit, s1, s2):
    for i in range(len(steps)):
        added = ridge * steps[i] + least
        a, b = max(aa[i], F32(0)) + added, max(bb[i], F32(0)) + added
        largest = limit * np.sqrt(a * b)
        both = max(min(ab[i], largest), -largest)
        determinant = a * b - both * both
        first = (bc[i] * both - ac[i] * b) / determinant
        second = (bc[i] * a - ac[i] * both) / determinant
        size = max(np.sqrt(first * first + second * second + F32(1e-12)), F32(1))
        s1[i], s2[i] = first / size, second / size


@_strips
def least_squares(
    moments: Float32[np.ndarray, "n c 6 p"],
    ridge: Float32[np.ndarray, " c"],
    least,
    limit,
    s1: Float32[np.ndarray, "n c p"],
    s2: Float32[np.ndarray, "n c p"],
):
    """Write the solutions of `redundancy.LeastSquares` at p pixels."""
    for row in prange(s1.shape[0] * s1.shape[1]):
        n, c = row // s1.shape[1], row % s1.shape[1]
        m = moments[n, c]
        _solve(m[0], m[1], m[2], m[3], m[4], m[5], ridge[c], least, limit, s1[n, c], s2[n, c])


@_row
def _add_products(values, left, right, sums):
    for j in range(len(left)):
        sums[2 * j] += left[j] * values[2 * j]
        sums[2 * j + 1] += right[j] * values[2 * j + 1]


@_strips
def add_moves(
    sums: Float32[np.ndarray, "m 2 h w"], gains: Float32[np.ndarray, "4*m h/2 w/2"], moves: Float32[np.ndarray, "2 h w"]
):
    """Add one of the terms of `refinement.event_moves`; `gains` are those before `pixel_shuffle`."""
    for y in prange(moves.shape[1]):
        for m in range(len(sums)):
            first = 4 * m + 2 * (y % 2)
            for k in range(2):
                _add_products(sums[m, k, y], gains[first, y // 2], gains[first + 1, y // 2], moves[k, y])
