"""Video files of pictures."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

CODEC = "mp4v"  # MPEG-4, which players show and browsers do not


def open_video(path: Path, rate_hz: float, shape: tuple[int, ...], without: str) -> cv2.VideoWriter:
    """A writer of pictures of this shape, with even sides.

    RuntimeError if OpenCV has no codec; `without` says how to go without the video.
    """
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), rate_hz, (shape[1], shape[0]))
    if not video.isOpened():
        raise RuntimeError(f"{path}: OpenCV cannot write it ({CODEC}); {without}")
    return video


def with_even_sides(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The picture with its last row and column repeated where a side is odd, because codecs want even sides."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
