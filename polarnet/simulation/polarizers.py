"""Polarizers of the simulated camera: extinction, angle errors, transmission, and the mosaic of a DoFP sensor.

A linear polarizer weights the Stokes parameters (`polarnet.stokes.analyzer`). Angle, extinction ratio and transmission
therefore describe a film or wire grid before a whole sensor. The micropolarizers of a DoFP sensor differ from pixel to
pixel, and a pixel receives some of its neighbours' light.
"""

import math
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float32, Float64
from pydantic import Field, NonNegativeFloat

from polarnet.events.mosaic import places_of
from polarnet.runtime.sections import one_of, section
from polarnet.simulation.pixels import randomness
from polarnet.simulation.ranges import RandomisedConfig
from polarnet.stokes import NUM_CHANNELS, POLARIZER_ANGLES_DEG, analyzer, parse_mosaic

Value = TypeVar("Value")
MAX_CROSSTALK = 0.8  # share of a pixel's light from its four neighbours; at 0.8 all five count alike


FourValues = Annotated[list[Value], Field(min_length=NUM_CHANNELS, max_length=NUM_CHANNELS)]


@section
class PolarizersConfig(RandomisedConfig):
    """Section `polarizers` of params.yaml. Lists hold one value for each of 0, 45, 90 and 135 degrees."""

    layout: Annotated[str, one_of(("four_sensors", "dofp"))]
    """four_sensors: each polarizer covers a sensor of its own; dofp: one sensor, one polarizer a pixel."""
    mosaic: str
    """Angles over 2x2 pixels of a DoFP sensor, even row / odd row."""
    extinction_ratio: FourValues[Annotated[float, Field(ge=1)] | None]
    """Transmission along the axis over that across it; null: infinite."""
    angle_error_deg: FourValues[Annotated[float, Field(ge=-90, le=90)]]
    transmission: FourValues[Annotated[float, Field(gt=0, le=1)]]
    """Transmission of light polarized along the axis."""
    extinction_spread: NonNegativeFloat
    """Standard deviation between pixels of the natural logarithm of the extinction ratio."""
    angle_spread_deg: NonNegativeFloat
    """Standard deviation of the angle between pixels."""
    transmission_spread: NonNegativeFloat
    """Relative standard deviation of the transmission between pixels."""
    crosstalk: Annotated[float, Field(ge=0, le=MAX_CROSSTALK)]
    """Share of a DoFP pixel's light that falls in through its four neighbours' polarizers."""

    def __post_init__(self):
        super().__post_init__()
        parse_mosaic(self.mosaic)
        if self.crosstalk and self.layout != "dofp":
            raise ValueError(
                f"crosstalk: expected 0 with layout {self.layout}, got {self.crosstalk}; "
                f"neighbours have different polarizers only with layout dofp"
            )

    @property
    def uniform(self) -> bool:
        """Whether each channel has a sensor of its own, all of whose pixels see through the same polarizer."""
        spread = self.extinction_spread or self.angle_spread_deg or self.transmission_spread
        return self.layout == "four_sensors" and not spread


IDEAL = PolarizersConfig(
    layout="four_sensors",
    mosaic="90 45 / 135 0",
    extinction_ratio=[None] * NUM_CHANNELS,
    angle_error_deg=[0.0] * NUM_CHANNELS,
    transmission=[1.0] * NUM_CHANNELS,
    extinction_spread=0.0,
    angle_spread_deg=0.0,
    transmission_spread=0.0,
    crosstalk=0.0,
    randomise=None,
)


class Grid(NamedTuple):
    """Pixels of a channel; they see points of the scene that lie `pitch` pixels apart: 1, or 2 for a DoFP sensor."""

    height: int
    width: int
    pitch: int = 1


def grid(layout: str, height: int, width: int) -> Grid:
    """The pixels of each channel of a sensor; ValueError for a DoFP sensor with an odd side."""
    if layout == "four_sensors":
        return Grid(height, width)
    if height % 2 or width % 2:
        raise ValueError(
            f"polarizers.layout dofp: expected a sensor with even sides, for whole 2x2 cells, got {height}x{width}"
        )
    return Grid(height // 2, width // 2, 2)


def channel_size(layout: str, height: int, width: int) -> tuple[int, int]:
    """Rows and columns of a channel of a sensor; ValueError as `grid`."""
    return grid(layout, height, width)[:2]


def weights_of(
    polarizers: PolarizersConfig, height: int, width: int, key: int
) -> Float32[np.ndarray, "sensors 3 *pixels"]:
    """Weights of S0, S1 and S2 at each of the four sensors, or the one DoFP sensor: for each pixel if pixels differ.

    `key` (64 bits) seeds the differences between pixels.
    """
    channels = np.arange(NUM_CHANNELS)
    if polarizers.layout == "dofp":
        grid(polarizers.layout, height, width)
        cell = np.searchsorted(POLARIZER_ANGLES_DEG, parse_mosaic(polarizers.mosaic))
        channels = np.tile(cell, (1, height // 2, width // 2))
    elif not polarizers.uniform:
        channels = np.broadcast_to(channels[:, None, None], (NUM_CHANNELS, height, width))

    def spread(purpose: int, deviation: float) -> Float64[np.ndarray, "*pixels"]:
        """Normally distributed differences between pixels."""
        if deviation == 0:
            return np.zeros(channels.shape)
        maps = [randomness.normal_map(np.uint64(key), purpose, i, channels[i].size) for i in range(len(channels))]
        return deviation * np.stack(maps).reshape(channels.shape).astype(np.float64)

    angles = np.radians(np.add(POLARIZER_ANGLES_DEG, polarizers.angle_error_deg))[channels]
    angles = angles + spread(randomness.POLARIZER_ANGLE, math.radians(polarizers.angle_spread_deg))
    along = np.array(polarizers.transmission)[channels]
    along = (along * (1 + spread(randomness.TRANSMISSION, polarizers.transmission_spread))).clip(0, 1)
    ratios = np.array([math.inf if ratio is None else ratio for ratio in polarizers.extinction_ratio])[channels]
    ratios = np.maximum(ratios * np.exp(spread(randomness.EXTINCTION, polarizers.extinction_spread)), 1)
    return analyzer(angles, ratios, along).swapaxes(0, 1).astype(np.float32)


def mixed_with_neighbours(frames: Float32[np.ndarray, "n h w"], crosstalk: float) -> Float32[np.ndarray, "n h w"]:
    """Light on a DoFP sensor with a share `crosstalk` from each pixel's four neighbours; edge pixels are repeated."""
    if crosstalk == 0:
        return frames
    padded = np.pad(frames, ((0, 0), (1, 1), (1, 1)), mode="edge")
    neighbours = padded[:, :-2, 1:-1] + padded[:, 2:, 1:-1] + padded[:, 1:-1, :-2] + padded[:, 1:-1, 2:]
    return np.float32(1 - crosstalk) * frames + np.float32(crosstalk / 4) * neighbours


def split_cells(frames: Float32[np.ndarray, "n h w"], mosaic: str) -> Float32[np.ndarray, "4 n h2 w2"]:
    """Channels at 0, 45, 90 and 135 degrees of a DoFP sensor's frames: each one pixel of every 2x2 cell."""
    return np.stack([frames[:, row::2, column::2] for row, column in places_of(parse_mosaic(mosaic))])
