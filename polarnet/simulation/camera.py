"""The simulated camera: its sensors, the polarizers before their pixels, and their readout.

Polarizers weight the Stokes parameters: films before whole sensors, or a mosaic. In the readout, all events of a row at
one time leave together, one row after another, and get their time when they leave. The bus carries a limited number of
events a second; rows that wait for too long are lost.
"""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor

from polarnet.events.stream import Events, places_of, select
from polarnet.runtime.compilation import compiled, forget_stale_code
from polarnet.runtime.machine import seed_for
from polarnet.runtime.sections import one_of, section
from polarnet.simulation.emulator import EmulatorConfig, draws
from polarnet.simulation.pixels import randomness
from polarnet.stokes import NUM_CHANNELS, POLARIZER_ANGLES_DEG, analyzer, parse_mosaic

Value = TypeVar("Value")
FourValues = Annotated[list[Value], Field(min_length=NUM_CHANNELS, max_length=NUM_CHANNELS)]
MAX_CROSSTALK = 0.8  # share of a pixel's light from its four neighbours; at 0.8 all five count alike


@section
class PolarizersConfig:
    """Section `polarizers` of params.yaml. Lists hold one value for each of 0, 45, 90 and 135 degrees."""

    layout: Annotated[str, one_of(("four_sensors", "dofp"))]
    """four_sensors: each polarizer covers a sensor of its own; dofp: one sensor, one polarizer a pixel."""
    mosaic: str
    """Angles over 2x2 pixels of a DoFP sensor, even row / odd row."""
    extinction_ratio: FourValues[Annotated[float, Field(ge=1)] | None]
    """Transmission along the axis over that across it; null: infinite."""
    angle_error_deg: FourValues[Annotated[float, Field(ge=-90, le=90)]]
    transmission: FourValues[Annotated[float, Field(gt=0, le=1)]]
    """Transmission of light polarized along the axis, 1 at most."""
    extinction_spread: NonNegativeFloat
    """Standard deviation between pixels of the natural logarithm of the extinction ratio, which is 1 at least.

    An infinite ratio (null) has no spread."""
    angle_spread_deg: NonNegativeFloat
    """Standard deviation of the angle between pixels."""
    transmission_spread: NonNegativeFloat
    """Relative standard deviation of the transmission between pixels, before it is clipped to [0, 1].

    With transmission 1, half of the pixels keep 1, and the mean falls to 1 - 0.4 x the spread: 0.988 at 0.03."""
    crosstalk: Annotated[float, Field(ge=0, le=MAX_CROSSTALK)]
    """Share of a DoFP pixel's light that falls in through its four neighbours' polarizers."""

    def __post_init__(self):
        parse_mosaic(self.mosaic)
        if self.crosstalk and self.layout != "dofp":
            raise ValueError(f"crosstalk: expected 0 with layout {self.layout}, got {self.crosstalk}")

    @property
    def uniform(self) -> bool:
        """Whether each channel has a sensor of its own, all of whose pixels see through the same polarizer."""
        spread = self.extinction_spread or self.angle_spread_deg or self.transmission_spread
        return self.layout == "four_sensors" and not spread


IDEAL = PolarizersConfig(
    layout="four_sensors", mosaic="90 45 / 135 0", extinction_ratio=[None] * NUM_CHANNELS,
    angle_error_deg=[0.0] * NUM_CHANNELS, transmission=[1.0] * NUM_CHANNELS, extinction_spread=0.0,
    angle_spread_deg=0.0, transmission_spread=0.0, crosstalk=0.0,
)  # fmt: skip


@section
class ReadoutConfig:
    """Section `readout` of params.yaml: how events leave the sensor."""

    max_events_per_s: PositiveFloat | None
    """Events that the bus of a sensor carries per second; null: no limit."""
    max_wait_us: NonNegativeFloat
    """Longest time that a row waits for the bus; a row that would wait longer is lost."""


PERFECT = ReadoutConfig(max_events_per_s=None, max_wait_us=0.0)


@dataclass(frozen=True)
class Camera:
    """A simulated camera: sections `emulate`, `polarizers` and `readout` of params.yaml.

    >>> from polarnet.simulation import POLARIZERS, SENSORS, Camera
    >>> Camera(SENSORS["noisy"], POLARIZERS["film"]).polarizers.transmission
    [0.737, 0.737, 0.737, 0.737]
    """

    sensor: EmulatorConfig
    polarizers: PolarizersConfig = IDEAL
    readout: ReadoutConfig = PERFECT
    key: int = 0  # modulo 2^64, seeds mismatch and noise: two cameras of one kind differ in it. `drawn` sets it.

    @property
    def sections(self) -> dict[str, Any]:
        """The sections by name."""
        return {
            "emulate": asdict(self.sensor),
            "polarizers": asdict(self.polarizers),
            "readout": asdict(self.readout),
        }

    def drawn(self, seed: int, sequence: str, purpose: str = "emulate") -> "Camera":
        """The camera of one sequence: with a key, and the sequence's own values for the ranges of `randomise`."""
        sensor = replace(self.sensor, **draws(self.sensor, seed, sequence), randomise=None)
        return replace(self, sensor=sensor, key=seed_for(seed, sequence, purpose))


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
        raise ValueError(f"layout dofp: expected a sensor with even sides, for whole 2x2 cells, got {height}x{width}")
    return Grid(height // 2, width // 2, 2)


def weights_of(
    polarizers: PolarizersConfig, height: int, width: int, key: int
) -> Float32[np.ndarray, "sensors 3 *pixels"]:
    """Weights of S0, S1 and S2 at each sensor, for each pixel if pixels differ, as `key` (modulo 2^64) seeds."""
    channels = np.arange(NUM_CHANNELS)
    if polarizers.layout == "dofp":
        grid(polarizers.layout, height, width)
        cell = np.searchsorted(POLARIZER_ANGLES_DEG, parse_mosaic(polarizers.mosaic))
        channels = np.tile(cell, (1, height // 2, width // 2))
    elif not polarizers.uniform:
        channels = np.broadcast_to(channels[:, None, None], (NUM_CHANNELS, height, width))

    def spread(purpose: int, deviation: float) -> Float64[np.ndarray, "*pixels"]:
        if deviation == 0:
            return np.zeros(channels.shape)
        seed = np.uint64(key % 2**64)
        maps = [randomness.normal_map(seed, purpose, i, channels[i].size) for i in range(len(channels))]
        return deviation * np.stack(maps).reshape(channels.shape).astype(np.float64)

    angles = np.radians(np.add(POLARIZER_ANGLES_DEG, polarizers.angle_error_deg))[channels]
    angles = angles + spread(randomness.POLARIZER_ANGLE, math.radians(polarizers.angle_spread_deg))
    along = np.array(polarizers.transmission)[channels]
    along = (along * (1 + spread(randomness.TRANSMISSION, polarizers.transmission_spread))).clip(0, 1)
    ratios = np.array([math.inf if ratio is None else ratio for ratio in polarizers.extinction_ratio])[channels]
    ratios = np.maximum(ratios * np.exp(spread(randomness.EXTINCTION, polarizers.extinction_spread)), 1)
    return analyzer(angles, ratios, along).swapaxes(0, 1).astype(np.float32)


def pixel_analyzers(camera: Camera, height: int, width: int) -> Float32[Tensor, "4 3 *pixels"]:
    """Analyzer of each pixel of the four channels of a camera whose sensors have this size.

    The light behind a pixel is a0 S0 + a1 S1 + a2 S2, so its polarizer has the angle atan2(a2, a1) / 2, and transmits
    a0 + hypot(a1, a2) along and a0 - hypot(a1, a2) across its axis. Crosstalk is included: then the sum holds where the
    pixel and its four neighbours see the same light. Shape (4, 3) if all pixels of a channel are alike, else
    (4, 3, rows, columns).

    >>> from polarnet.simulation import POLARIZERS, SENSORS, Camera, pixel_analyzers
    >>> pixel_analyzers(Camera(SENSORS["default"], POLARIZERS["micropolarizers"], key=1), 120, 180).shape
    torch.Size([4, 3, 60, 90])
    """
    weights, polarizers = weights_of(camera.polarizers, height, width, camera.key), camera.polarizers
    if polarizers.layout == "dofp":
        weights = split_cells(mixed_with_neighbours(weights[0], polarizers.crosstalk), polarizers.mosaic)
    pixels = weights.reshape(NUM_CHANNELS, 3, -1)
    alike = (pixels == pixels[..., :1]).all()
    return torch.from_numpy(pixels[..., 0].copy() if alike else weights)


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


def read_out(events: Events, config: ReadoutConfig, duration_us: int) -> Events:
    """The events of one sensor as they leave it, in time order.

    Events lost on the bus are missing, and those that would leave after `duration_us`.
    """
    if config.max_events_per_s is None:
        return events
    forget_stale_code(Path(__file__).parent)
    rows, times_us = events.y.numpy().astype(np.int64), events.t.numpy().astype(np.float64)
    leaves_us, carried = _bus(times_us, rows, 1e6 / config.max_events_per_s, config.max_wait_us)
    stamps = np.rint(leaves_us).astype(np.int64)
    left = torch.from_numpy(carried & (stamps <= duration_us))
    return replace(select(events, left), t=torch.from_numpy(stamps)[left])


@compiled
def _bus(
    times_us: Float64[np.ndarray, " n"], rows: Int64[np.ndarray, " n"], event_us: float, max_wait_us: float
) -> tuple[Float64[np.ndarray, " n"], np.ndarray]:
    """Time at which each event leaves the bus, which takes `event_us` per event, and whether the bus carries it."""
    leaves_us, carried = np.empty(times_us.size), np.zeros(times_us.size, np.bool_)
    free_us, first = -np.inf, 0
    while first < times_us.size:
        stop = first + 1
        while stop < times_us.size and rows[stop] == rows[first] and times_us[stop] - times_us[first] < 1:
            stop += 1
        start_us = max(free_us, times_us[first])
        row_carried = start_us - times_us[first] <= max_wait_us
        if row_carried:
            free_us = start_us + event_us * (stop - first)
        for i in range(first, stop):
            carried[i] = row_carried
            leaves_us[i] = free_us if row_carried else times_us[i]
        first = stop
    return leaves_us, carried
