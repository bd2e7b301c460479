"""Interpolated frames between those of a clip, so that nothing moves by more than about one pixel a step, as in v2e.

v2e interpolates with a network (SuperSloMo); here the frames before and after are warped along the optical flow (DIS,
Kroeger et al. 2016) and blended. Both are wrong where one thing hides another.
"""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

MAX_STEP_PX = 1.0
FLOW_QUANTILE = 0.999  # quantile of the flow's length taken as the motion: pixels without texture get arbitrary flow


class StokesFrame(NamedTuple):
    """Light on a sensor at one time."""

    t_us: int
    stokes: Float32[Tensor, "3 h w"]


def upsampled(frames: Iterable[StokesFrame]) -> Iterator[StokesFrame]:
    """Yield the frames, with interpolated frames evenly spaced between them, at whole microseconds."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    before: StokesFrame | None = None
    for after in frames:
        if before is not None:
            yield from _between(before, after, dis)
        yield after
        before = after


def _between(before: StokesFrame, after: StokesFrame, dis: cv2.DISOpticalFlow) -> Iterator[StokesFrame]:
    first_grey, last_grey = _grey(before.stokes[0], after.stokes[0])
    start = np.zeros((*first_grey.shape, 2), np.float32)
    forward, backward = dis.calc(first_grey, last_grey, start.copy()), dis.calc(last_grey, first_grey, start.copy())
    moved = float(np.quantile(np.hypot(*np.moveaxis(forward, -1, 0)), FLOW_QUANTILE))
    steps = max(1, min(math.ceil(moved / MAX_STEP_PX), after.t_us - before.t_us))
    first, last = (np.ascontiguousarray(frame.stokes.numpy().transpose(1, 2, 0)) for frame in (before, after))
    for k in range(1, steps):
        s = k / steps
        # flow from the time between back to either frame, as SuperSloMo approximates it (Jiang et al. 2018, Eq. 4)
        to_first = s * s * backward - (1 - s) * s * forward
        to_last = (1 - s) ** 2 * forward - s * (1 - s) * backward
        blend = (1 - s) * _warped(first, to_first) + s * _warped(last, to_last)
        t_us = before.t_us + round(s * (after.t_us - before.t_us))
        yield StokesFrame(t_us, torch.from_numpy(np.ascontiguousarray(blend.transpose(2, 0, 1))))


def _grey(before: Float32[Tensor, "h w"], after: Float32[Tensor, "h w"]) -> list[UInt8[np.ndarray, "h w"]]:
    """S0 of both frames in 8 bits, the brightest pixel white."""
    white = max(float(before.max()), float(after.max())) or 1.0
    return [np.rint(s0.numpy() * (255 / white)).astype(np.uint8) for s0 in (before, after)]


def _warped(frame: Float32[np.ndarray, "h w 3"], flow: Float32[np.ndarray, "h w 2"]) -> Float32[np.ndarray, "h w 3"]:
    """The frame at the places that `flow` points to; weighted means of Stokes parameters stay physical."""
    rows, columns = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
    x, y = columns + flow[..., 0].astype(np.float32), rows + flow[..., 1].astype(np.float32)
    return cv2.remap(frame, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
