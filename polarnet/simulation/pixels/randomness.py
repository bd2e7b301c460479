"""Counter-based random numbers: a value is a hash of (key, counter), independent of the order of evaluation."""

import math

import numpy as np

from polarnet.runtime.compilation import borrowing, compiled, inlined

GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # 2^64 / golden ratio: the increment of SplitMix64 (Steele et al., OOPSLA 2014)
MIX_1, MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)  # its output function, variant 13
DIGITS, BYTE_SUMS = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
DIGITS_MEAN, DIGITS_SCALE = np.float32(60.0), np.float32(1 / math.sqrt(170.0))  # for sums of eight numbers in 0..15

# Purposes: each random quantity of a channel has a key of its own.
THRESHOLD_ON, THRESHOLD_OFF, NOISE_RATE, LEAK_PHASE, LEAK_JITTER, SHOT_NOISE, FIRST_PASSAGE = range(1, 8)
POLARIZER_ANGLE, EXTINCTION, TRANSMISSION = range(8, 11)
HOT, PHOTORECEPTOR = 12, 14


@inlined
def mixed(key, counter):
    """64 random bits of draw number `counter` under `key`: the output of SplitMix64 with seed `key`."""
    z = key + GOLDEN * (np.uint64(counter) + np.uint64(1))
    z = (z ^ (z >> np.uint64(30))) * MIX_1
    z = (z ^ (z >> np.uint64(27))) * MIX_2
    return z ^ (z >> np.uint64(31))


@compiled
def key_for(key, purpose, channel):
    """The key of one purpose in one channel, from the key of the sequence."""
    return mixed(mixed(key, purpose), channel)


@inlined
def uniform(bits):
    """A double in (0, 1) from 64 random bits; never 0 or 1."""
    return (np.float64(bits >> np.uint64(12)) + 0.5) * 2.0**-52


@inlined
def rough_normal(bits):
    """A nearly Gaussian number of mean 0 and variance 1 from 64 random bits: see `rough_normals`."""
    sums = ((bits & DIGITS) + ((bits >> np.uint64(4)) & DIGITS)) * BYTE_SUMS
    return (np.float32((sums >> np.uint64(24)) & np.uint64(255)) - DIGITS_MEAN) * DIGITS_SCALE


@borrowing
def rough_normals(key, first_pixel, values):
    """Fill `values` (float32) with nearly Gaussian numbers: standardised sums of eight random digits from 0 to 15.

    Mean 0, variance 1, excess kurtosis -0.15, |value| <= 4.6. One hash serves two pixels, to save time.
    """
    half = (values.size + 1) // 2
    left, right = values[:half], values[values.size - half :]
    for j in range(half):
        bits = mixed(key, first_pixel + j)
        sums = ((bits & DIGITS) + ((bits >> np.uint64(4)) & DIGITS)) * BYTE_SUMS
        low, both = np.float32((sums >> np.uint64(24)) & np.uint64(255)), np.float32(sums >> np.uint64(56))
        left[j] = (low - DIGITS_MEAN) * DIGITS_SCALE
        right[j] = (both - low - DIGITS_MEAN) * DIGITS_SCALE


@compiled
def normal(u):
    """The standard normal quantile of u in (0, 1): Wichura's AS 241 (PPND7), accurate to about 1e-7."""
    q = u - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        top = ((59.109374720 * r + 159.29113202) * r + 50.434271938) * r + 3.3871327179
        return q * top / (((67.187563600 * r + 78.757757664) * r + 17.895169469) * r + 1.0)
    r = math.sqrt(-math.log(u if q < 0 else 1.0 - u))
    if r <= 5.0:
        r -= 1.6
        top = ((0.17023821103 * r + 1.3067284816) * r + 2.7568153900) * r + 1.4234372777
        x = top / ((0.12021132975 * r + 0.73700164250) * r + 1.0)
    else:
        r -= 5.0
        top = ((0.017337203997 * r + 0.42868294337) * r + 3.0812263860) * r + 6.6579051150
        x = top / ((0.012258202635 * r + 0.24197894225) * r + 1.0)
    return -x if q < 0 else x


@compiled
def normal_map(key, purpose, channel, pixels):
    """One standard normal number per pixel of a channel, float32."""
    key = key_for(key, purpose, channel)
    values = np.empty(pixels, np.float32)
    for i in range(pixels):
        values[i] = normal(uniform(mixed(key, i)))
    return values
