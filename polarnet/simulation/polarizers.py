"""Polarizers of the simulated camera: extinction, angle errors, transmission, and the mosaic of a DoFP sensor.

A linear polarizer weights the Stokes parameters (`polarnet.stokes.analyzer`). Angle, extinction ratio and transmission
therefore describe a film or wire grid before a whole sensor. The micropolarizers of a DoFP sensor differ from pixel to
pixel, and a pixel receives some of its neighbours' light.
"""

import math
from typing import Annotated, TypeVar

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


def channel_size(layout: str, height: int, width: int) -> tuple[int, int]:
    """Rows and columns of a channel of a sensor; ValueError for a DoFP sensor with an odd side."""
    if layout == "four_sensors":
        return height, width
    if height % 2 or width % 2:
        raise ValueError(
            f"polarizers.layout dofp: expected a sensor with even sides, for whole 2x2 cells, got {height}x{width}"
        )
    return height // 2, width // 2


def grid(layout: str, height: int, width: int) -> tuple[int, int, int]:
    """(rows, columns, pitch) of a sensor's channel; its pixels are `pitch` sensor pixels apart: 1, or 2 for DoFP."""
    rows, columns = channel_size(layout, height, width)
    return rows, columns, height // rows


def analyzers(polarizers: PolarizersConfig) -> Float32[np.ndarray, "4 3"]:
    """Weights of (S0, S1, S2) of each channel, without differences between pixels."""
    angles = np.radians(np.add(POLARIZER_ANGLES_DEG, polarizers.angle_error_deg))
    weights = list(map(analyzer, angles.tolist(), _ratios(polarizers), polarizers.transmission))
    return np.array(weights, np.float32)


def _ratios(polarizers: PolarizersConfig) -> list[float]:
    return [math.inf if ratio is None else ratio for ratio in polarizers.extinction_ratio]


def analyzer_maps(
    polarizers: PolarizersConfig, height: int, width: int, key: int
) -> Float32[np.ndarray, "sensors 3 h w"]:
    """Weights of (S0, S1, S2) at every pixel of the four sensors, or of the one DoFP sensor.

    `key` (64 bits) seeds the differences between pixels.
    """
    if polarizers.layout == "four_sensors":
        channels = np.broadcast_to(np.arange(NUM_CHANNELS)[:, None, None], (NUM_CHANNELS, height, width))
    else:
        channel_size(polarizers.layout, height, width)
        cell = np.searchsorted(POLARIZER_ANGLES_DEG, parse_mosaic(polarizers.mosaic))
        channels = np.tile(cell, (1, height // 2, width // 2))
    angles = np.radians(np.add(POLARIZER_ANGLES_DEG, polarizers.angle_error_deg))[channels]
    angles = angles + math.radians(polarizers.angle_spread_deg) * _normal(randomness.POLARIZER_ANGLE, channels, key)
    along = np.array(polarizers.transmission)[channels]
    along = along * (1 + polarizers.transmission_spread * _normal(randomness.TRANSMISSION, channels, key))
    along = along.clip(0, 1)
    exponents = polarizers.extinction_spread * _normal(randomness.EXTINCTION, channels, key)
    across = along / np.maximum(np.array(_ratios(polarizers))[channels] * np.exp(exponents), 1)
    polarized = (along - across) / 2
    weights = ((along + across) / 2, polarized * np.cos(2 * angles), polarized * np.sin(2 * angles))
    return np.stack(weights, axis=1).astype(np.float32)


def _normal(purpose: int, channels: np.ndarray, key: int) -> Float64[np.ndarray, "sensors h w"]:
    """Standard normal values for the pixels of each sensor."""
    pixels = channels[0].size
    maps = [randomness.normal_map(np.uint64(key), purpose, sensor, pixels) for sensor in range(len(channels))]
    return np.stack(maps).reshape(channels.shape).astype(np.float64)


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
