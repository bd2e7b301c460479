"""What falls on one plane of pixels, row by row: frames, or a window that moves over a still scene.

Light is in digital numbers (DN): 0 dark, 255 the brightest a picture can be.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import compiled, inlined

BYTES, FLOATS, SCENE = range(3)
FULL_SCALE = 255.0  # DN
KNEE = 20.0  # DN below which v2e's response is linear
LINLOG_TABLE = np.array(
    [round(i * math.log(KNEE) / KNEE if i <= KNEE else math.log(i), 8) for i in range(256)], dtype=np.float32
)


class Light(NamedTuple):
    """The light of one plane at successive times; `kind` says which of the fields holds it."""

    frames_8bit: np.ndarray
    """uint8 [n, h, w]"""
    frames: np.ndarray
    """float32 [n, h, w], DN"""
    scene: np.ndarray
    """float32 [H + 1, W + 1], DN: the last row and column repeat their neighbours, so that 2x2 pixels always exist"""
    top: np.ndarray
    """float64 [n]: row of the scene at the window's first pixel"""
    left: np.ndarray
    """float64 [n]: its column"""
    kind: int


NO_8BIT, NO_FRAMES = np.empty((0, 0, 0), np.uint8), np.empty((0, 0, 0), np.float32)
NO_SCENE, NO_PLACES = np.empty((0, 0), np.float32), np.empty(0, np.float64)


def light_of_frames(frames: np.ndarray) -> Light:
    """Light from frames [n, h, w], uint8 or float32."""
    if frames.dtype == np.uint8:
        return Light(frames, NO_FRAMES, NO_SCENE, NO_PLACES, NO_PLACES, BYTES)
    return Light(NO_8BIT, frames, NO_SCENE, NO_PLACES, NO_PLACES, FLOATS)


def light_of_scene(scene: np.ndarray, top: np.ndarray, left: np.ndarray) -> Light:
    """Light in a window that moves over `scene` (padded, see `Light`) without turning."""
    return Light(NO_8BIT, NO_FRAMES, scene, top, left, SCENE)


@compiled
def intensity_rows(light, k, y, w, dn):
    """Fill `dn` (float32, whole rows of w pixels) with the light at time k from row y on."""
    for r in range(dn.size // w):
        row = dn[r * w : (r + 1) * w]
        if light.kind == BYTES:
            row[:] = light.frames_8bit[k, y + r]
        elif light.kind == FLOATS:
            row[:] = light.frames[k, y + r]
        else:
            _bilinear_row(light.scene, light.top[k] + (y + r), light.left[k], row)


@compiled
def _bilinear_row(scene, row, column, dn):
    i, j, w = math.floor(row), math.floor(column), dn.size
    down, right = np.float32(row - i), np.float32(column - j)
    one = np.float32(1)
    w00, w01 = (one - down) * (one - right), (one - down) * right
    w10, w11 = down * (one - right), down * right
    # four slices with one index: the compiler vectorises these, and not offsets of one slice
    a, b = scene[i, j : j + w], scene[i, j + 1 : j + 1 + w]
    c, d = scene[i + 1, j : j + w], scene[i + 1, j + 1 : j + 1 + w]
    for x in range(w):
        dn[x] = (w00 * a[x] + w01 * b[x]) + (w10 * c[x] + w11 * d[x])


@compiled
def linlog_8bit(dn, linlog):
    """v2e's response to `dn`, which is rounded to whole numbers, as an 8-bit video would hold."""
    for j in range(dn.size):
        whole = np.int32(dn[j] + np.float32(0.5)) & np.int32(255)
        dn[j] = np.float32(whole)
        linlog[j] = LINLOG_TABLE[whole]


@compiled
def linlog_as_v2e(dn, linlog):
    """v2e's response to any DN >= 0, with its rounding: ln(DN) above 20, linear below; double precision inside."""
    for j in range(dn.size):
        value = np.float64(dn[j])
        response = value * (math.log(KNEE) / KNEE) if value <= KNEE else math.log(value)
        linlog[j] = np.float32(np.rint(response * 1e8) / 1e8)


# ln(1 + x) = x - x^2 / 2 + x^3 P(x) for 1 + x in [sqrt(1/2), sqrt(2)], and ln 2 in two parts (Cephes' logf); P is
# evaluated in pairs (Estrin's scheme)
LOG_POLYNOMIAL = tuple(
    np.float32(c)
    for c in (
        7.0376836292e-2,
        -1.1514610310e-1,
        1.1676998740e-1,
        -1.2420140846e-1,
        1.4249322787e-1,
        -1.6668057665e-1,
        2.0000714765e-1,
        -2.4999993993e-1,
        3.3333331174e-1,
    )
)
LN2_HIGH, LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
SQRT_HALF_BITS, MANTISSA_BITS = np.int32(0x3F3504F3), np.int32(23)
KNEE_32, SLOPE_32 = np.float32(KNEE), np.float32(math.log(KNEE) / KNEE)


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


@compiled
def linlog(dn, response):
    """v2e's response to any DN >= 0, in float32 throughout."""
    for j in range(dn.size):
        logarithm = ln(max(dn[j], KNEE_32))
        response[j] = logarithm if dn[j] > KNEE_32 else dn[j] * SLOPE_32
