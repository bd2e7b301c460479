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
from jaxtyping import Float32
from torch import Tensor

from polarnet.stokes import intensities_from_stokes

MAX_STEP_PX = 1.0
CONTRAST_SIDE = 15  # pixels of the square over which contrast is averaged
FAINT = 1.0  # squared slope, in steps of 8 bits, that every intensity counts for where nothing has contrast
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
    forward, backward, moved = _flows(before, after, dis)
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


def _flows(
    before: StokesFrame, after: StokesFrame, dis: cv2.DISOpticalFlow
) -> tuple[Float32[np.ndarray, "h w 2"], Float32[np.ndarray, "h w 2"], float]:
    """Flow from one frame to the other and back, and the largest motion behind the four polarizers, in pixels.

    A place moves as the four intensities do on average, each weighted by its contrast there: texture may be in DoLP or
    AoLP alone, and then S0 shows no motion.
    """
    light = [intensities_from_stokes(frame.stokes).clamp(min=0).numpy() for frame in (before, after)]
    white = max(float(one.max()) for one in light) or 1.0
    flows, weights = [], []
    for first, last in zip(*(np.rint(one * (255 / white)).astype(np.uint8) for one in light), strict=True):
        start, slopes = np.zeros((*first.shape, 2), np.float32), np.stack(cv2.spatialGradient(first)).astype(np.float32)
        flows.append((dis.calc(first, last, start.copy()), dis.calc(last, first, start.copy())))
        weights.append(cv2.blur(np.square(slopes).sum(axis=0), (CONTRAST_SIDE, CONTRAST_SIDE)) + np.float32(FAINT))
    moved = max(float(np.quantile(np.hypot(*np.moveaxis(forward, -1, 0)), FLOW_QUANTILE)) for forward, _ in flows)
    shares = (weights / np.sum(weights, axis=0))[:, None, ..., None]
    forward, backward = (shares * np.array(flows)).sum(axis=0)
    return forward, backward, moved


def _warped(frame: Float32[np.ndarray, "h w 3"], flow: Float32[np.ndarray, "h w 2"]) -> Float32[np.ndarray, "h w 3"]:
    """The frame at the places that `flow` points to; weighted means of Stokes parameters stay physical."""
    rows, columns = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
    x, y = columns + flow[..., 0].astype(np.float32), rows + flow[..., 1].astype(np.float32)
    return cv2.remap(frame, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
