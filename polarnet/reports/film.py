"""Maps as bytes, for films that a page plays: fractions, angles and signed event counts."""

import math

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

NO_EVENTS = 128
"""Byte of a pixel with as many ON as OFF events."""


def fraction_bytes(fraction: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """DoLP or intensity in steps of 1/255; values outside 0 to 1 are clamped."""
    return (fraction.clamp(0, 1) * 255).round().to(torch.uint8)


def angle_bytes(aolp: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """AoLP in radians, period pi, in steps of pi/256."""
    return (aolp * (256 / math.pi)).round().remainder(256).to(torch.uint8)


def signed_bytes(counts: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """ON minus OFF events, clamped to -127 .. 127, plus `NO_EVENTS`."""
    return (counts.round().clamp(-127, 127) + NO_EVENTS).to(torch.uint8)
