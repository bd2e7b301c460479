"""Scenes of polarized light: Stokes parameters, constant in time, from photographs or from measured intensities."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from polarnet.runtime import arrays
from polarnet.runtime.arrays import Array, check_range, check_shape, floats, fractions
from polarnet.stokes import stokes_from_intensities, stokes_from_polarization

EPSILON = np.finfo(np.float32).eps  # keeps grey and black from dividing by 0
LIGHT_RANGE = 1e8
"""Brightest over darkest light of a picture of light in scenes.zarr: less than 0.000003 DN is dark, the smallest dark
current being 0.0001 DN. The store's 16 bits are logarithmic then, in steps of 0.03 %."""


@dataclass(frozen=True)
class PolarizationScene:
    """Stokes parameters of the area that a sensor moves over: S0 in [0, 1], S1, S2 with hypot(S1, S2) <= S0.

    The constructor checks shape and type only; `check_scene` checks every pixel.

    >>> import torch
    >>> from polarnet.simulation import PolarizationScene
    >>> PolarizationScene(torch.zeros(3, 240, 320)).width
    320
    """

    stokes: Float32[Tensor, "3 h w"]

    def __post_init__(self):
        check_shape("stokes", arrays.as_tensor("stokes", self.stokes), "3 height width")
        if not isinstance(self.stokes, Tensor) or self.stokes.dtype != torch.float32:
            raise TypeError(f"stokes: expected a torch tensor of float32, got {self.stokes.dtype}")

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.stokes.shape[1]

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.stokes.shape[2]


def check_scene(scene: PolarizationScene) -> None:
    """Raise ValueError for an unphysical scene: NaN, S0 outside [0, 1], or hypot(S1, S2) above S0."""
    arrays.check_finite("scene", scene.stokes)
    s0, s1, s2 = scene.stokes
    check_range("scene", s0, 0, 1, "S0")
    excess = float((torch.hypot(s1, s2) - s0).max())
    if excess > arrays.TOLERANCE:
        raise ValueError(
            f"scene: expected hypot(S1, S2) <= S0, got an excess of {excess:g}; "
            f"scene_from_intensities scales noisy measurements down"
        )


def polarization_from_rgb(rgb: Float[Array, "3 h w"]) -> Float32[Tensor, "3 h w"]:
    """(S0, DoLP, AoLP) of a picture: its value, saturation and hue (paper, section 3.1).

    The full circle of hue maps to AoLP in [0, pi): red 0, green pi/3, blue 2 pi/3. Grey has DoLP 0 and AoLP 0.
    TypeError if `rgb` is not an array; ValueError for integers, values outside [0, 1], another order of axes, NaN and
    infinity.
    """
    hue, saturation, value = _hsv(fractions("picture", rgb, "3 height width", "RGB"))
    aolp = hue * (math.pi / 360)
    return torch.stack([value, saturation, torch.where(aolp >= math.pi, 0.0, aolp)])


def scene_from_polarization(
    s0: Float[Array, "h w"], dolp: Float[Array, "h w"], aolp: Float[Array, "h w"]
) -> PolarizationScene:
    """The scene with given intensity and DoLP, both in [0, 1], and AoLP in radians.

    TypeError for arguments that are not arrays; ValueError for different shapes, integers, NaN, intensities and DoLP
    outside [0, 1], and angles outside [-pi, pi], which are probably in degrees.

    >>> import torch
    >>> from polarnet.simulation import scene_from_polarization
    >>> scene_from_polarization(*torch.full((2, 240, 320), 0.5), torch.zeros(240, 320)).stokes[:, 0, 0]
    tensor([0.5000, 0.2500, 0.0000])
    """
    s0, dolp = (fractions(name, image, "height width").float() for name, image in (("s0", s0), ("dolp", dolp)))
    aolp = floats("aolp", aolp, "height width").float()
    arrays.check_same_shape({"s0": s0, "dolp": dolp, "aolp": aolp})
    check_range("aolp", aolp, -math.pi, math.pi, "radians", "convert degrees with torch.deg2rad")
    return PolarizationScene(stokes_from_polarization(s0, dolp, aolp))


def scene_from_rgb(rgb: Float[Array, "3 h w"]) -> PolarizationScene:
    """The scene whose (S0, DoLP, AoLP) are those of `polarization_from_rgb`, which says what is raised.

    >>> import torch
    >>> from polarnet.simulation import scene_from_rgb
    >>> scene_from_rgb(torch.full((3, 240, 320), 0.5)).stokes[:, 0, 0]
    tensor([0.5000, 0.0000, 0.0000])
    """
    return scene_from_polarization(*polarization_from_rgb(rgb))


def polarization_from_light(light: Float[Array, "3 h w"]) -> Float32[Tensor, "3 h w"]:
    """As `polarization_from_rgb`, for linear light of many decades: hue and saturation are right in the dark, too."""
    light = fractions("light", light, "3 height width", "RGB").float()
    value = light.amax(dim=0)
    _, dolp, aolp = polarization_from_rgb(light / torch.where(value > 0, value, 1.0))
    return torch.stack([value, dolp, aolp])


def scene_from_light(light: Float[Array, "3 h w"]) -> PolarizationScene:
    """The scene of linear RGB light in [0, 1], as `read_light` reads it; raises as `scene_from_rgb`.

    >>> import torch
    >>> from polarnet.simulation import scene_from_light
    >>> scene_from_light(torch.tensor([1e-6, 5e-7, 5e-7]).view(3, 1, 1)).stokes[:, 0, 0]
    tensor([1.0000e-06, 5.0000e-07, 0.0000e+00])
    """
    return scene_from_polarization(*polarization_from_light(light))


def stretched(scene: PolarizationScene, dynamic_range: float | None) -> PolarizationScene:
    """The scene with S0 replaced by dynamic_range^(S0 - 1), from 1 / dynamic_range to 1; DoLP and AoLP stay.

    The code values of a photograph become the logarithm of its light. None returns the scene itself.

    >>> import torch
    >>> from polarnet.simulation.scene import scene_from_rgb, stretched
    >>> stretched(scene_from_rgb(torch.full((3, 2, 2), 0.5)), 1e6).stokes[0, 0, 0]
    tensor(0.0010)
    """
    if dynamic_range is None:
        return scene
    s0 = scene.stokes[0].double()
    light = torch.exp((s0 - 1) * math.log(dynamic_range))
    shares = torch.where(s0 > 0, scene.stokes[1:].double() / torch.where(s0 > 0, s0, 1.0), 0.0)
    return PolarizationScene(torch.cat([light[None], shares * light]).float())


def logarithmic(s0: Float[Tensor, "h w"], dynamic_range: float) -> Float32[Tensor, "h w"]:
    """The S0 that `stretched` stretches to this one; light below 1 / dynamic_range counts as that.

    >>> import torch
    >>> from polarnet.simulation.scene import logarithmic
    >>> logarithmic(torch.tensor([[1.0, 0.001, 0.0]]), 1e6)
    tensor([[1.0000, 0.5000, 0.0000]])
    """
    return (1 + s0.double().clamp(min=1 / dynamic_range).log() / math.log(dynamic_range)).clamp(0, 1).float()


def scene_from_intensities(intensities: Float[Array, "4 h w"]) -> PolarizationScene:
    """The scene measured behind polarizers at 0, 45, 90 and 135 degrees, in linear light, I0 + I90 at most 1.

    Noise makes some measurements unphysical: S1 and S2 are scaled down where hypot(S1, S2) exceeds S0.
    TypeError as for `scene_from_polarization`; ValueError for integers, NaN, another order of axes, negative values and
    S0 above 1.

    >>> import torch
    >>> from polarnet.simulation import scene_from_intensities
    >>> scene_from_intensities(torch.full((4, 240, 320), 0.25)).stokes[:, 0, 0]
    tensor([0.5000, 0.0000, 0.0000])
    """
    stokes = stokes_from_intensities(fractions("intensities", intensities, "4 height width").float())
    check_range("intensities", stokes[0], 0, 1, "S0 = I0 + I90", "divide the intensities by the largest S0")
    s0, s1, s2 = stokes
    length = torch.hypot(s1, s2)
    shrink = torch.where(length > s0, s0 / torch.where(length > 0, length, 1.0), 1.0)
    return PolarizationScene(torch.stack([s0, s1 * shrink, s2 * shrink]))


def _hsv(rgb: Float[Tensor, "3 h w"]) -> Float32[Tensor, "3 h w"]:
    """Hue in degrees, saturation and value in [0, 1]: those of OpenCV on processors with FMA, on any processor."""
    red, green, blue = pixels = rgb.numpy().astype(np.float32)
    value = pixels.max(axis=0)
    chroma = value - pixels.min(axis=0)
    saturation = chroma / (value + EPSILON)
    degrees = (np.float32(60) / (chroma + EPSILON)).astype(np.float64)
    # each difference is rounded to float32, their sums with the offsets only at the end, as FMA does
    from_red = (green - blue) * degrees
    from_green, from_blue = (blue - red) * degrees + 120, (red - green) * degrees + 240
    hue = np.select([value == red, value == green], [from_red + 360 * (from_red < 0), from_green], from_blue)
    return torch.from_numpy(np.stack([hue.astype(np.float32), saturation, value]))
