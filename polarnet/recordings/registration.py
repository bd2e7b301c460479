"""Register four separate cameras: find a homography between two event images, and move events by it.

The cameras look at the same scene from nearly the same place, so one homography suffices for scenes that are flat or
far away. It maximises the correlation of the two event images (Evangelidis and Psarakis 2008, in OpenCV), from coarse
to fine. Images behind different polarizers differ in brightness, but their edges lie at the same places.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64

from polarnet.events.stream import Events
from polarnet.recordings.pixels import event_counts
from polarnet.recordings.source import RecordingError

SCALES = (4, 2, 1)
MIN_SIDE = 48  # pixels; smaller images show too little
BLUR = 5  # pixels; smoothing of the images during the comparison
ITERATIONS, CHANGE = 200, 1e-6
FINE, COARSE = 1.0, 4.0  # pixels; standard deviations of the band that contains the edges
UNRELATED = 0.25  # edge correlation; simulated recordings of different scenes mostly stay below 0.18


class Registration(NamedTuple):
    """Map from pixels (x, y, 1) of one camera to those of another, with its quality."""

    homography: Float64[np.ndarray, "3 3"]
    correlation: float
    """Correlation of the registered event images where they overlap."""
    edge_correlation: float
    """Correlation of their fine detail where they overlap; below `UNRELATED`, the homography means nothing."""


def event_image(events: Events) -> Float32[np.ndarray, "h w"]:
    """log(1 + events) of each pixel, scaled to 0 to 1, so that busy edges do not outshine the others."""
    image = np.log1p(event_counts(events).astype(np.float32))
    return image / max(float(image.max()), 1e-6)


def register(reference: Float32[np.ndarray, "h w"], moving: Float32[np.ndarray, "h2 w2"]) -> Registration:
    """The homography from pixels of `moving` to pixels of `reference`.

    RecordingError where the images show different things, that is, no shift of one correlates with the other.
    """
    if reference.shape != moving.shape:
        raise RecordingError(f"expected two event images of one size, got {reference.shape} and {moving.shape}")
    (shift_x, shift_y), _ = cv2.phaseCorrelate(
        reference.astype(np.float64),
        moving.astype(np.float64),
        cv2.createHanningWindow(reference.shape[::-1], cv2.CV_64F),
    )
    warp = np.array([[1, 0, shift_x], [0, 1, shift_y], [0, 0, 1]], np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, ITERATIONS, CHANGE)
    correlation = 0.0
    for scale in SCALES:
        size = reference.shape[1] // scale, reference.shape[0] // scale
        if scale > 1 and min(size) < MIN_SIDE:
            continue
        a, b = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (reference, moving))
        to_coarse = np.diag([1 / scale, 1 / scale, 1]).astype(np.float32)
        coarse = to_coarse @ warp @ np.linalg.inv(to_coarse)
        everywhere = np.ones(a.shape, np.uint8)
        try:
            correlation, coarse = cv2.findTransformECC(
                a, b, coarse.astype(np.float32), cv2.MOTION_HOMOGRAPHY, criteria, everywhere, BLUR
            )
        except cv2.error:
            correlation = 0.0
        if not correlation > 0:  # refuses NaN too
            raise RecordingError(
                "the two event images show too little in common to lay them on each other; record something with many "
                "edges that moves in front of both cameras"
            )
        warp = (np.linalg.inv(to_coarse) @ coarse @ to_coarse).astype(np.float32)
    homography = np.linalg.inv(warp.astype(np.float64))
    homography /= homography[2, 2]
    return Registration(homography, float(correlation), _edge_correlation(reference, moving, homography))


def _edge_correlation(
    reference: Float32[np.ndarray, "h w"],
    moving: Float32[np.ndarray, "h w"],
    homography: Float64[np.ndarray, "3 3"],
) -> float:
    """Correlation of fine detail, which aligning broad shapes alone does not raise."""
    both = warped(np.ones_like(moving), homography) > 1 - 1e-3
    a, b = (_edges(image)[both] for image in (reference, warped(moving, homography)))
    spread = float(a.std() * b.std()) if both.any() else 0.0
    return float(((a - a.mean()) * (b - b.mean())).mean()) / spread if spread > 0 else 0.0


def _edges(image: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    return cv2.GaussianBlur(image, (0, 0), FINE) - cv2.GaussianBlur(image, (0, 0), COARSE)


def warped(image: Float32[np.ndarray, "h w"], homography: Float64[np.ndarray, "3 3"]) -> Float32[np.ndarray, "h w"]:
    """An event image as the reference camera would see it; 0 outside its overlap."""
    return cv2.warpPerspective(image, homography, image.shape[::-1])


def warp_events(events: Events, homography: Float64[np.ndarray, "3 3"]) -> Events:
    """Move events to the nearest pixel of the reference camera; those outside its view are left out."""
    xy = np.stack([events.x.numpy(), events.y.numpy(), np.ones(len(events))])
    x, y, w = homography @ xy
    column, row = np.rint(x / w), np.rint(y / w)
    inside = (w > 0) & (column >= 0) & (column < events.width) & (row >= 0) & (row < events.height)
    x16, y16 = (torch.from_numpy(side[inside].astype(np.int16)) for side in (column, row))
    keep = torch.from_numpy(inside)
    return Events(events.t[keep], x16, y16, events.p[keep], events.height, events.width)
