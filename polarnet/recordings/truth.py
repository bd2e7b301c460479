"""True polarization from the frames that a camera with a polarizer mosaic records beside its events (such as a PDAVIS).

E2P's files hold maps of S0, DoLP and AoLP, which are the truth as published: computed in each cell of 2x2 pixels from
its four pixels. Raw frames are demosaicked instead, since the four pixels look at different places, and Eq. 1-3 give
the truth.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from polarnet.events.stream import places_of
from polarnet.pictures.polarimetry import levels_at_angles, white_level
from polarnet.recordings.recording import FORMATS, detect_format
from polarnet.recordings.source import CameraFrames, RecordingError
from polarnet.stokes import (
    Mosaic,
    aolp,
    dolp,
    intensities_from_stokes,
    stokes_from_intensities,
    stokes_from_polarization,
)


class Truth(NamedTuple):
    """True polarization of a recording's frames; a map has a pixel for each cell of the mosaic."""

    t_us: Int64[np.ndarray, " n"]
    """Times of the frames, by the clock of the events."""
    intensity: Float[Tensor, "n 4 h w"]
    """Behind the polarizers at 0, 45, 90 and 135 degrees; 0.5 at saturation."""
    dolp: Float[Tensor, "n h w"]
    aolp: Float[Tensor, "n h w"]
    valid: Bool[Tensor, "n h w"]
    """False where pixels are saturated, and in demosaicked frames on the rim and without light."""
    light: Float32[np.ndarray, "n 2*h 2*w"]
    """Light behind each pixel's own polarizer; 1 at saturation."""


def truth_formats() -> list[str]:
    """Keys of FORMATS whose files can hold frames."""
    return [name for name, form in FORMATS.items() if form.frames is not None]


def read_truth(path: Path, mosaic: Mosaic) -> Truth:
    """True polarization in a recording; RecordingError if it holds no frames, or frames whose times do not increase."""
    name = detect_format(path)
    read = FORMATS[name].frames
    if read is None:
        raise RecordingError(f"{path.name}: expected a format with frames, {', '.join(truth_formats())}; got {name}")
    frames = read(path)
    if len(frames.t_us) > 1 and not (np.diff(frames.t_us) > 0).all():
        raise RecordingError(f"{path.name}: expected times of frames that increase; the file is damaged")
    if frames.maps is not None:
        return _from_maps(frames, mosaic)
    return _demosaicked(frames, mosaic)


def check_size(path: Path, truth: Truth, height: int, width: int) -> None:
    """RecordingError unless the frames are those of a sensor of this size, without a last odd row or column."""
    expected, size = (height // 2 * 2, width // 2 * 2), truth.light.shape[1:]
    if size != expected:
        raise RecordingError(
            f"{path.name}: expected frames of the sensor's {height}x{width} px, got {size[0]}x{size[1]}"
        )


def _from_maps(frames: CameraFrames, mosaic: Mosaic) -> Truth:
    """The file's own maps; its raw frames, if there, tell which cells are saturated."""
    assert frames.maps is not None
    s0, true_dolp, true_aolp = (torch.from_numpy(one) for one in frames.maps)
    intensity = intensities_from_stokes(stokes_from_polarization(s0, true_dolp, true_aolp))
    n, height, width = s0.shape
    if frames.levels is None:
        light = np.empty((n, 2 * height, 2 * width), np.float32)
        for (row, column), plane in zip(places_of(mosaic), intensity.unbind(1), strict=True):
            light[:, row::2, column::2] = 2 * plane.numpy()
        return Truth(frames.t_us, intensity, true_dolp, true_aolp, s0 <= 1, light)
    levels = frames.levels[:, : 2 * height, : 2 * width]
    white = white_level(levels)
    cells = (levels < white).reshape(n, height, 2, width, 2).all(axis=(2, 4))
    light = levels.astype(np.float32) / np.float32(white)
    return Truth(frames.t_us, intensity, true_dolp, true_aolp, torch.from_numpy(cells), light)


def _demosaicked(frames: CameraFrames, mosaic: Mosaic) -> Truth:
    """Eq. 1-3 of each demosaicked frame; `demosaic` leaves out the rim of one cell, which is not valid here."""
    assert frames.levels is not None
    n, height, width = len(frames.levels), frames.levels.shape[1] // 2, frames.levels.shape[2] // 2
    levels, white = frames.levels[:, : 2 * height, : 2 * width], white_level(frames.levels)
    intensity = torch.zeros(n, 4, height, width, dtype=torch.float64)
    valid = torch.zeros(n, height, width, dtype=torch.bool)
    for k, frame in enumerate(levels):
        values, saturated = levels_at_angles(frame[None], white, mosaic)
        intensity[k, :, 1:-1, 1:-1] = torch.from_numpy(values)
        valid[k, 1:-1, 1:-1] = torch.from_numpy(saturated.sum(axis=0) <= 1)
    stokes = stokes_from_intensities(intensity)
    valid &= stokes[:, 0] > 0  # without light there is no polarization
    light = levels.astype(np.float32) / np.float32(white)
    return Truth(frames.t_us, intensity.float(), dolp(stokes).clamp(0, 1).float(), aolp(stokes).float(), valid, light)
