"""Polarization optics: Stokes vectors, DoLP, AoLP and the intensity behind a polarizer (paper Eq. 1-4).

Angles of polarizers and of polarization count anticlockwise from the right, in an image whose first row is the top.

Functions take numpy arrays or torch tensors and return tensors. They raise TypeError for anything but an array of real
numbers, and ValueError for other axes or for integers, whose differences wrap around. All values are allowed,
including NaN.
"""

import math
import re
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from polarnet.runtime.arrays import Array, as_tensor, check_floating, check_same_shape, check_shape

POLARIZER_ANGLES_DEG = (0, 45, 90, 135)
NUM_CHANNELS = len(POLARIZER_ANGLES_DEG)

Mosaic = tuple[tuple[int, int], tuple[int, int]]
"""Polarizer angles of a 2x2 mosaic: the even row, then the odd row."""


class Prediction(NamedTuple):
    """Polarization predicted by a network or any other method; maps that the method lacks are None."""

    dolp: Float[Tensor, "*b h w"]
    """In [0, 1] when returned by a method; the raw output of a network is not clamped."""
    aolp: Float[Tensor, "*b h w"] | None = None
    """Radians in [0, pi)."""
    log_variance: Float[Tensor, "*b h w"] | None = None
    """Natural logarithm of the expected squared error of DoLP."""
    stokes: Float[Tensor, "*b 2 h w"] | None = None
    """s1 = S1 / S0 and s2 = S2 / S0, from which `aolp` is computed."""
    intensities: Float[Tensor, "*b 4 h w"] | None = None
    """Intensities behind the polarizers at 0, 45, 90 and 135 degrees from which DoLP was computed."""


class StokesFrames(NamedTuple):
    """What the frames of a polarization camera show of s1 = S1 / S0 and s2 = S2 / S0."""

    t_us: Int64[np.ndarray, " n"]
    """Times of the frames; they increase."""
    stokes: Float[Tensor, "n 2 h w"]
    valid: Bool[Tensor, "n h w"]
    """Whether a pixel is known, such as one that is not saturated."""

    def since(self, t_us: int) -> "StokesFrames":
        """The same frames by a clock that starts at `t_us` of this one."""
        return self._replace(t_us=self.t_us - t_us)

    def between(self, start_us: int, stop_us: int) -> "StokesFrames":
        """The frames of this time, both ends included."""
        first, last = np.searchsorted(self.t_us, [start_us, stop_us + 1])
        return StokesFrames(self.t_us[first:last], self.stokes[first:last], self.valid[first:last])


def stokes_from_intensities(intensities: Float[Array, "*b 4 h w"]) -> Float[Tensor, "*b 3 h w"]:
    """(S0, S1, S2) from intensities behind linear polarizers at 0, 45, 90 and 135 degrees (paper Eq. 1)."""
    i0, i45, i90, i135 = _planes("intensities", intensities, "... 4 height width").unbind(-3)
    return torch.stack([i0 + i90, i0 - i90, i45 - i135], dim=-3)


def stokes_from_polarization(
    s0: Float[Array, "*b h w"], dolp: Float[Array, "*b h w"], aolp: Float[Array, "*b h w"]
) -> Float[Tensor, "*b 3 h w"]:
    """(S0, S1, S2) from intensity, degree and angle (radians) of linear polarization: Eq. 2 and 3 inverted."""
    s0, dolp, aolp = (
        _planes(name, plane, "... height width") for name, plane in (("s0", s0), ("dolp", dolp), ("aolp", aolp))
    )
    check_same_shape({"s0": s0, "dolp": dolp, "aolp": aolp})
    polarized = s0 * dolp
    return torch.stack([s0, polarized * torch.cos(2 * aolp), polarized * torch.sin(2 * aolp)], dim=-3)


Values = float | Float64[np.ndarray, "..."]


def analyzer(
    angle: Values, extinction_ratio: Values = math.inf, transmission: Values = 1.0
) -> Float64[np.ndarray, "3 ..."]:
    """Weights of S0, S1 and S2 behind linear polarizers, whose weighted sum is the intensity (paper Eq. 4).

    This is the first row of a polarizer's Mueller matrix, without circular polarization. `angle` of the transmission
    axis in radians; `transmission` for light polarized along the axis, and `extinction_ratio` times less across it
    (infinite: ideal). Numbers, or arrays that broadcast.
    """
    along, twice = np.asarray(transmission, np.float64), np.multiply(2.0, angle)
    across = along / extinction_ratio
    polarized = (along - across) / 2
    weights = (along + across) / 2, polarized * np.cos(twice), polarized * np.sin(twice)
    return np.stack(np.broadcast_arrays(*weights))


def intensity_behind_polarizer(stokes: Float[Array, "*b 3 h w"], angle: float) -> Float[Tensor, "*b h w"]:
    """Intensity behind an ideal linear polarizer at `angle` radians, from Stokes vectors.

    S0 (1 - DoLP) / 2 + S0 DoLP cos^2(angle - AoLP) = (S0 + S1 cos(2 angle) + S2 sin(2 angle)) / 2.
    """
    s0, s1, s2 = _planes("stokes", stokes, "... 3 height width").unbind(-3)
    a, b, c = analyzer(angle).tolist()
    return a * s0 + b * s1 + c * s2


def intensities_from_stokes(stokes: Float[Array, "*b 3 h w"]) -> Float[Tensor, "*b 4 h w"]:
    """Intensities behind polarizers at 0, 45, 90 and 135 degrees (paper Eq. 4)."""
    return torch.stack(
        [intensity_behind_polarizer(stokes, math.radians(angle)) for angle in POLARIZER_ANGLES_DEG], dim=-3
    )


def dolp(stokes: Float[Array, "*b 3 h w"]) -> Float[Tensor, "*b h w"]:
    """Degree of linear polarization (paper Eq. 2); 0 without light, NaN where a Stokes parameter is NaN.

    Not clamped: intensities reconstructed from events can be unphysical, with a DoLP above 1.
    """
    s0, s1, s2 = _planes("stokes", stokes, "... 3 height width").unbind(-3)
    polarized = torch.hypot(s1, s2)
    dark = (s0 <= 0) & ~polarized.isnan()
    return torch.where(dark, 0.0, polarized / torch.where(dark, 1.0, s0))


def aolp(stokes: Float[Array, "*b 3 h w"]) -> Float[Tensor, "*b h w"]:
    """Angle of linear polarization in radians, [0, pi) (paper Eq. 3, over the whole circle); 0 if unpolarized."""
    _, s1, s2 = _planes("stokes", stokes, "... 3 height width").unbind(-3)
    angle = (torch.atan2(s2.double(), s1.double()) / 2).to(s1.dtype)  # float32 would depend on the processor
    folded = torch.where(angle < 0, angle + math.pi, angle)
    return torch.where(folded >= math.pi, 0.0, folded)  # -1e-9 + pi rounds to pi


def parse_mosaic(order: str) -> Mosaic:
    """Angles of a 2x2 mosaic from text like "90 45 / 135 0": even row, then odd row; ValueError for other text."""
    match = re.fullmatch(r"\s*(\d+)\s+(\d+)\s*/\s*(\d+)\s+(\d+)\s*", order)
    angles = [int(angle) for angle in match.groups()] if match else []
    if sorted(angles) != sorted(POLARIZER_ANGLES_DEG):
        raise ValueError(f'mosaic: expected the angles 0, 45, 90 and 135 like "90 45 / 135 0", got {order!r}')
    return (angles[0], angles[1]), (angles[2], angles[3])


def _planes(name: str, values: Array, axes: str) -> Float[Tensor, "*shape"]:
    tensor = as_tensor(name, values)
    check_shape(name, values, axes)
    check_floating(name, tensor)
    return tensor
