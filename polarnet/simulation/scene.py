"""Scenes of polarized light: still Stokes pictures, from photographs or from measured intensities."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from polarnet.stokes import stokes_from_intensities, stokes_from_polarization


@dataclass(frozen=True)
class PolarizationScene:
    """Stokes parameters of the area that a sensor moves over: S0 in [0, 1], S1, S2 with hypot(S1, S2) <= S0."""

    stokes: Float32[Tensor, "3 h w"]

    @property
    def height(self) -> int:
        """Rows."""
        return self.stokes.shape[1]

    @property
    def width(self) -> int:
        """Columns."""
        return self.stokes.shape[2]


def polarization_from_rgb(rgb: Float[Tensor, "3 h w"]) -> Float32[Tensor, "3 h w"]:
    """(S0, DoLP, AoLP) of a picture in [0, 1]: its value, saturation and hue (paper, section 3.1).

    The circle of hues is the half circle of angles: red 0, green pi/3, blue 2 pi/3. Grey has DoLP 0 and AoLP 0.
    """
    hue, saturation, value = _hsv(rgb)
    aolp = hue * (math.pi / 360)
    return torch.stack([value, saturation, torch.where(aolp >= math.pi, 0.0, aolp)])


def scene_from_polarization(
    s0: Float[Tensor, "h w"], dolp: Float[Tensor, "h w"], aolp: Float[Tensor, "h w"]
) -> PolarizationScene:
    """The scene of given intensity in [0, 1], degree and angle (radians) of linear polarization."""
    return PolarizationScene(stokes_from_polarization(s0, dolp, aolp))


def scene_from_rgb(rgb: Float[Tensor, "3 h w"]) -> PolarizationScene:
    """The scene whose (S0, DoLP, AoLP) are the value, saturation and hue of a picture in [0, 1]."""
    return scene_from_polarization(*polarization_from_rgb(rgb))


def scene_from_intensities(intensities: Float[Tensor, "4 h w"]) -> PolarizationScene:
    """The scene measured behind polarizers at 0, 45, 90 and 135 degrees, in linear light, I0 + I90 at most 1.

    Noise makes some measurements unphysical: S1 and S2 are shrunk where their length exceeds S0.
    """
    stokes = stokes_from_intensities(intensities.float())
    s0, s1, s2 = stokes
    length = torch.hypot(s1, s2)
    shrink = torch.where(length > s0, s0 / torch.where(length > 0, length, 1.0), 1.0)
    return PolarizationScene(torch.stack([s0, s1 * shrink, s2 * shrink]))


def _hsv(rgb: Float[Tensor, "3 h w"]) -> Float32[Tensor, "3 h w"]:
    """Hue in degrees, saturation and value in [0, 1]."""
    pixels = np.ascontiguousarray(rgb.permute(1, 2, 0).numpy(), dtype=np.float32)
    return torch.from_numpy(cv2.cvtColor(pixels, cv2.COLOR_RGB2HSV)).permute(2, 0, 1)
