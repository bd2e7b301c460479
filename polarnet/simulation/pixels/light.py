"""Light on the pixels of one channel in digital numbers (DN, 255: a picture's brightest value), and the response.

The response is v2e's, ln(DN) above a knee and linear below, or with `dark_dn` the smooth ln(DN + dark_dn).
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.runtime.compilation import borrowing, compiled, inlined

FULL_SCALE = 255.0  # DN
KNEE = 20.0  # DN below which v2e's response is linear
MIN_DARK_DN = 1e-4  # keeps the logarithm of no light finite


class Light(NamedTuple):
    """The light on one channel at successive times: a clip of frames, or a still scene under a drifting sensor."""

    images: np.ndarray
    """A clip: uint8 or float32 [n, h, w], DN. A scene: float32 [1, H + 1, W + 1], DN; the last row and column repeat
    their neighbours, so that each sensor pixel lies between 2x2 scene pixels."""
    top: np.ndarray = np.empty(0)  # float64 [n], scene row at the sensor's first pixel; empty for a clip
    left: np.ndarray = np.empty(0)  # float64 [n], scene column at the sensor's first pixel; empty for a clip


@borrowing
def intensity_rows(light, frame, row, width, dn):
    """Fill `dn` (float32, whole rows of `width` pixels) with the light of one frame from `row` on."""
    for r in range(dn.size // width):
        target = dn[r * width : (r + 1) * width]
        if light.top.size:
            _bilinear_row(light.images, light.top[frame] + (row + r), light.left[frame], target)
        else:
            source = light.images[frame, row + r]
            for x in range(width):
                target[x] = source[x]


@borrowing
def _bilinear_row(images, row, column, dn):
    i, j, w = math.floor(row), math.floor(column), dn.size
    down, right = np.float32(row - i), np.float32(column - j)
    one = np.float32(1)
    w00, w01 = (one - down) * (one - right), (one - down) * right
    w10, w11 = down * (one - right), down * right
    # four slices with one index: the compiler vectorises these, and not offsets of one slice
    a, b = images[0, i, j : j + w], images[0, i, j + 1 : j + 1 + w]
    c, d = images[0, i + 1, j : j + w], images[0, i + 1, j + 1 : j + 1 + w]
    for x in range(w):
        dn[x] = (w00 * a[x] + w01 * b[x]) + (w10 * c[x] + w11 * d[x])


@borrowing
def respond_8bit(dn, table, response):
    """Response to 8-bit light: rounds `dn` to whole numbers in place, then looks them up in `table_of_response`."""
    whole = response.view(np.int32)  # two loops, because the compiler vectorises the first only without the table
    for j in range(dn.size):
        whole[j] = np.int32(dn[j] + np.float32(0.5)) & np.int32(255)
        dn[j] = np.float32(whole[j])
    for j in range(dn.size):
        response[j] = table[np.uint64(whole[j])]


@compiled
def table_of_response(physics):
    """Response to 0 to 255 DN."""
    table = np.empty(256, np.float32)
    respond_as_v2e(np.arange(256).astype(np.float32), physics, table)
    return table


@borrowing
def respond_as_v2e(dn, physics, response):
    """Response to any DN >= 0, computed in float64 and rounded as v2e rounds it."""
    knee, slope, dark = physics.knee_dn, physics.knee_slope, physics.dark_dn
    for j in range(dn.size):
        value = np.float64(dn[j])
        exact = value * slope if value <= knee else math.log(value + dark)
        response[j] = np.float32(np.rint(exact * 1e8) / 1e8)


# ln(1 + x) = x - x^2 / 2 + x^3 P(x) for 1 + x in [sqrt(1/2), sqrt(2)], and ln 2 in two parts (Cephes' logf); P is
# evaluated in pairs (Estrin's scheme)
LOG_POLYNOMIAL = tuple(map(np.float32, (
    7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1,
    -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1,
)))  # fmt: skip
LN2_HIGH, LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
SQRT_HALF_BITS, MANTISSA_BITS = np.int32(0x3F3504F3), np.int32(23)


@inlined
def ln(x):
    """The natural logarithm of a positive float32, right to 1.2 units in the last place; vectorises."""
    p0, p1, p2, p3, p4, p5, p6, p7, p8 = LOG_POLYNOMIAL
    bits = np.float32(x).view(np.int32)
    exponent = np.int32(np.int32(bits - SQRT_HALF_BITS) >> MANTISSA_BITS)
    f = np.float32(np.int32(bits - np.int32(exponent << MANTISSA_BITS)).view(np.float32)) - np.float32(1)
    e, square = np.float32(exponent), f * f
    fourth = square * square
    low = ((p7 * f + p8) + (p5 * f + p6) * square) + ((p3 * f + p4) + (p1 * f + p2) * square) * fourth
    cubic = (low + p0 * (fourth * fourth)) * (f * square)
    return (f + ((cubic + e * LN2_LOW) - np.float32(0.5) * square)) + e * LN2_HIGH


@borrowing
def respond(dn, physics, response):
    """Response to any DN >= 0, in float32 throughout."""
    knee, slope, dark = np.float32(physics.knee_dn), np.float32(physics.knee_slope), np.float32(physics.dark_dn)
    for j in range(dn.size):
        logarithm = ln(max(dn[j] + dark, knee))
        response[j] = logarithm if dn[j] > knee else dn[j] * slope
