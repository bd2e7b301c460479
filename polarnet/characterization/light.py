"""Known light on a camera (frames with their times, or a sinusoidal flicker), and its change between events of a pixel.

Light is in digital numbers (DN): 0 is dark, 255 white.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.optimize import minimize_scalar

from polarnet.characterization.intervals import Intervals, PixelEvents, chosen_pixels, intervals_of, undisturbed
from polarnet.events.stream import Events
from polarnet.pictures.clips import TIMES_FILE, check_times, times_from_file
from polarnet.pictures.images import picture_extensions, read_channels
from polarnet.simulation.compilation import compiled
from polarnet.simulation.pixels.light import FULL_SCALE, KNEE
from polarnet.simulation.pixels.physics import DARK_OFFSET, SATURATION

LUMINANCE = (0.2126, 0.7152, 0.0722)  # of sRGB's primaries (IEC 61966-2-1)
STEPS_PER_CYCLE = 256  # linear pieces of a flicker's cycle: 3e-4 of the contrast off at most
PIECES = 4  # linear pieces of the response between two frames
SETTLED = 12.0  # time constants of the photoreceptor after which a cycle repeats itself
SETTLING_US = 100_000  # after the first frame, left out, because the photoreceptor's state is unknown
PHASES = 32
PHASE_INTERVALS = 6000  # intervals that the phase of a flicker is fitted to
BLOCK = 8  # consecutive intervals; even blocks make one half of the data, odd blocks the other


@dataclass(frozen=True)
class MovingLight:
    """Light on every pixel at successive times; between two frames the pixel's response is a cubic (`_responses`)."""

    frames: Float32[np.ndarray, "n h w"]
    """DN"""
    t_us: Float64[np.ndarray, " n"]
    """Times of the frames on the recording's clock."""


@dataclass(frozen=True)
class Flicker:
    """The same light on all pixels: level (1 + contrast sin(2 pi frequency t + phase))."""

    level: float
    """Mean, DN."""
    contrast: float
    """(brightest - darkest) / (brightest + darkest)"""
    frequency_hz: float

    def __post_init__(self):
        if not 0 < self.contrast < 1:
            raise ValueError(f"contrast: expected (max - min) / (max + min) between 0 and 1, got {self.contrast}")
        if not self.frequency_hz > 0:
            raise ValueError(f"frequency: expected Hz above 0, got {self.frequency_hz}")
        if not 0 < self.level <= FULL_SCALE / (1 + self.contrast):
            raise ValueError(
                f"flicker light: expected a mean above 0 DN whose maximum, mean x (1 + contrast), is at most "
                f"{FULL_SCALE:g} DN, got {self.level} DN at contrast {self.contrast}; lower the mean"
            )


def read_light(folder: Path, height: int, width: int) -> MovingLight:
    """Frames of `folder` in the order of their names, with the times in its `timestamps.txt`.

    Frames are 8- or 16-bit pictures (white becomes 255 DN; colour becomes luminance without linearisation) or .npy
    files in DN. `timestamps.txt` has one time per line in microseconds of the recording's clock; further words of a
    line and lines that start with # are ignored. ValueError where the frames do not fit the sensor or the times.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: there is no such folder; name the folder of the frames")
    kinds = picture_extensions() | {"npy"}
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower().lstrip(".") in kinds)
    t_us = times_from_file(folder / TIMES_FILE, "us")
    if len(paths) != len(t_us) or len(paths) < 2:
        raise ValueError(
            f"{folder}: expected at least two frames and one time for each, got {len(paths)} frames and "
            f"{len(t_us)} times; {TIMES_FILE} needs one line per frame, in the order of the names"
        )
    check_times(t_us, TIMES_FILE)
    frames = np.empty((len(paths), height, width), np.float32)
    for frame, path in zip(frames, paths, strict=True):
        light = _read_frame(path)
        if light.shape != (height, width):
            raise ValueError(
                f"{path.name}: expected a frame of the sensor's {height} x {width} px (height x width), got "
                f"{light.shape[0]} x {light.shape[1]}; cut and scale the frames to the pixels of the sensor"
            )
        frame[:] = light
    return MovingLight(frames, t_us)


def _read_frame(path: Path) -> Float[np.ndarray, "h w"]:
    if path.suffix.lower() == ".npy":
        light = np.load(path)
    else:
        pixels = read_channels(path)
        white = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1.0
        light = pixels.astype(np.float32) * (FULL_SCALE / white)
        light = light[..., :3] @ np.array(LUMINANCE, np.float32) if light.shape[-1] >= 3 else light[..., 0]
    if light.ndim != 2 or not np.isfinite(light).all() or light.min() < 0 or light.max() > FULL_SCALE * (1 + 1e-6):
        raise ValueError(f"{path.name}: expected one value from 0 to {FULL_SCALE:g} DN per pixel, [height, width]")
    return light


def moving_responses(
    light: MovingLight, pixel: Int64[np.ndarray, " n"], t_us: Float64[np.ndarray, " n"], cutoff_hz: float
) -> Float64[np.ndarray, " n"]:
    """Filtered response of each event's pixel at its time; NaN outside the frames' times.

    Events are ordered by pixel, then time. Between two frames the response to the light is a cubic (Catmull and Rom) in
    `PIECES` linear pieces; its slope at a frame is that of a parabola through three frames. A straight line would shift
    increments of short and long intervals by different amounts and so feign a leak. The filter is that of
    `pixels.exact` with the bandwidth at the mean light of a piece. It starts adapted to the first frame.
    """
    frames = light.frames.reshape(len(light.frames), -1)
    starts = np.searchsorted(pixel, np.arange(frames.shape[1] + 1))
    return _responses(frames, light.t_us, starts, t_us, cutoff_hz)


def flicker_cycle(flicker: Flicker, cutoff_hz: float) -> Float64[np.ndarray, " n"]:
    """Filtered response over one settled cycle, from phase 0 to 2 pi inclusive, in `STEPS_PER_CYCLE` steps."""
    slowest_hz = cutoff_hz * (flicker.level * (1 - flicker.contrast) + DARK_OFFSET) / SATURATION
    cycles = 2 + (math.ceil(SETTLED * flicker.frequency_hz / (2 * math.pi * slowest_hz)) if cutoff_hz > 0 else 0)
    phase = np.arange(cycles * STEPS_PER_CYCLE + 1) * (2 * math.pi / STEPS_PER_CYCLE)
    light = flicker.level * (1 + flicker.contrast * np.sin(phase))
    t_us = phase / (2e-6 * math.pi * flicker.frequency_hz)
    responses = _responses(
        light.astype(np.float32)[:, None], t_us, np.array([0, len(t_us)]), np.minimum(t_us, t_us[-1] - 1e-3), cutoff_hz
    )
    return responses[-STEPS_PER_CYCLE - 1 :]


def flicker_responses(
    cycle: Float64[np.ndarray, " k"], frequency_hz: float, phase: float, t_us: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Filtered response at the times of events, from `flicker_cycle`, for a flicker of `phase` at time 0."""
    turns = (t_us * (1e-6 * frequency_hz) + phase / (2 * math.pi)) % 1.0
    return np.interp(turns, np.linspace(0, 1, len(cycle)), cycle)


@dataclass(frozen=True)
class KnownLight:
    """A recording under known light."""

    name: str
    events: Events
    light: MovingLight | Flicker


class Source(NamedTuple):
    """Intervals of a recording under known light, and the filtered response at its events for a bandwidth."""

    name: str
    events: PixelEvents
    intervals: Intervals
    responses: Callable[[PixelEvents, float], Float64[np.ndarray, " n"]]
    moves: bool
    """Whether the light is a moving scene with frames, not a flicker."""


class Increments(NamedTuple):
    """Changes of the filtered log light between two events of a pixel, times the polarity of the second event."""

    increment: Float64[np.ndarray, " n"]
    duration_s: Float64[np.ndarray, " n"]
    pixel: Int64[np.ndarray, " n"]
    on: Bool[np.ndarray, " n"]
    block: Int64[np.ndarray, " n"]


def source_of(known: KnownLight, events: PixelEvents, refractory_us: float) -> Source:
    """The intervals of a recording under known light that neither start-up nor refractory period disturbs."""
    intervals = undisturbed(intervals_of(events), refractory_us)
    light = known.light
    if isinstance(light, MovingLight):
        after = events.t_us[intervals.start] >= light.t_us[0] + SETTLING_US
        intervals = Intervals(*(column[after] for column in intervals))

        def responses(some: PixelEvents, cutoff_hz: float) -> Float64[np.ndarray, " n"]:
            return moving_responses(light, some.pixel, some.t_us, cutoff_hz)
    else:
        flicker = exact_frequency(light, events)

        @functools.cache
        def cycle_and_phase(cutoff_hz: float) -> tuple[Float64[np.ndarray, " k"], float]:
            cycle = flicker_cycle(flicker, cutoff_hz)
            return cycle, flicker_phase(cycle, flicker.frequency_hz, events, intervals)

        def responses(some: PixelEvents, cutoff_hz: float) -> Float64[np.ndarray, " n"]:
            cycle, phase = cycle_and_phase(cutoff_hz)
            return flicker_responses(cycle, flicker.frequency_hz, phase, some.t_us)

    return Source(known.name, events, intervals, responses, isinstance(light, MovingLight))


def increments_of(sources: Sequence[Source], cutoff_hz: float) -> Increments:
    """Increments of all sources, for a photoreceptor of bandwidth `cutoff_hz` at full brightness (0: infinite)."""
    parts = []
    for source in sources:
        response, intervals = source.responses(source.events, cutoff_hz), source.intervals
        increment = np.where(intervals.on, 1.0, -1.0) * (response[intervals.stop] - response[intervals.start])
        covered, block = np.isfinite(increment), np.arange(len(increment)) // BLOCK
        columns = increment, intervals.duration_us * 1e-6, intervals.pixel, intervals.on, block
        parts.append([column[covered] for column in columns])
    return Increments(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def at_pixels(source: Source, mask: Bool[np.ndarray, " pixels"]) -> Source:
    """The part of a source at some pixels."""
    selected = mask[source.events.pixel]
    number = np.cumsum(selected) - 1
    chosen = mask[source.intervals.pixel]
    start, stop = number[source.intervals.start[chosen]], number[source.intervals.stop[chosen]]
    rest = (column[chosen] for column in source.intervals[2:])
    return source._replace(events=chosen_pixels(source.events, mask), intervals=Intervals(start, stop, *rest))


def exact_frequency(flicker: Flicker, events: PixelEvents) -> Flicker:
    """The flicker with its frequency on the recording's clock, from the drift of the phase of its events."""
    t_s, sign = events.t_us * 1e-6, np.where(events.on, 1.0, -1.0)
    middle = 0.5 * (t_s.min() + t_s.max())
    frequency = flicker.frequency_hz
    for parts in (8, 2):
        edges = np.linspace(t_s.min(), t_s.max(), parts + 1)
        phase = 2 * math.pi * frequency * (t_s - middle)
        real, imaginary = (np.histogram(t_s, edges, weights=sign * wave(phase))[0] for wave in (np.cos, np.sin))
        phasors = real - 1j * imaginary
        turn = np.angle((phasors[1:] * phasors[:-1].conj()).sum())
        frequency += turn / (2 * math.pi * (edges[1] - edges[0]))
    return replace(flicker, frequency_hz=float(frequency))


def flicker_phase(
    cycle: Float64[np.ndarray, " k"], frequency_hz: float, events: PixelEvents, intervals: Intervals
) -> float:
    """Phase of the flicker at time 0, radians, which makes the increments of each polarity most nearly equal."""
    step = max(1, len(intervals.start) // PHASE_INTERVALS)
    start_us, stop_us = events.t_us[intervals.start[::step]], events.t_us[intervals.stop[::step]]
    on = intervals.on[::step]

    def unequal(phase: float) -> float:
        rise = flicker_responses(cycle, frequency_hz, phase, stop_us)
        rise -= flicker_responses(cycle, frequency_hz, phase, start_us)
        total = 0.0
        for values in (rise[on], -rise[~on]):
            if len(values):
                middle = float(np.median(values))
                total += float(np.median(np.abs(values - middle))) / middle if middle > 0 else 10.0
        return total

    grid = np.arange(PHASES) * (2 * math.pi / PHASES)
    best = grid[np.argmin([unequal(phase) for phase in grid])]
    width = 2 * math.pi / PHASES
    return float(minimize_scalar(unequal, bounds=(best - width, best + width), method="bounded").x)


@compiled
def _response(dn):
    return dn * (math.log(KNEE) / KNEE) if dn <= KNEE else math.log(dn)


@compiled
def _light(response):
    knee = math.log(KNEE)
    return max(response, 0.0) * (KNEE / knee) if response <= knee else math.exp(response)


@compiled
def _responses(frames, times_us, starts, t_us, cutoff_hz):
    values = np.full(t_us.size, np.nan)
    frame_count = times_us.size
    for i in range(starts.size - 1):
        event, stop = starts[i], starts[i + 1]
        while event < stop and t_us[event] < times_us[0]:
            event += 1
        lag, before, after = 0.0, _response(np.float64(frames[0, i])), _response(np.float64(frames[1, i]))
        tangent = (after - before) / (times_us[1] - times_us[0])
        for k in range(frame_count - 1):
            if event >= stop:
                break
            duration = times_us[k + 1] - times_us[k]
            beyond, next_tangent = after, (after - before) / duration
            if k + 2 < frame_count:  # slope of the parabola through three frames
                beyond, next_duration = _response(np.float64(frames[k + 2, i])), times_us[k + 2] - times_us[k + 1]
                next_tangent *= next_duration / (duration + next_duration)
                next_tangent += (beyond - after) / next_duration * (duration / (duration + next_duration))
            c1, rise = tangent * duration, after - before
            c2, c3 = 3 * rise - 2 * c1 - next_tangent * duration, c1 + next_tangent * duration - 2 * rise
            piece_us, response, piece_start_us = duration / PIECES, before, times_us[k]
            light = _light(response)
            for piece in range(1, PIECES + 1):
                u = piece / PIECES
                response_after = before + u * (c1 + u * (c2 + u * c3))
                slope = (response_after - response) / piece_us
                light_after = _light(response_after)
                per_us = 2e-6 * math.pi * cutoff_hz * (0.5 * (light + light_after) + DARK_OFFSET) / SATURATION
                end_us = times_us[k + 1] if piece == PIECES else piece_start_us + piece_us
                while event < stop and t_us[event] < end_us:
                    since = t_us[event] - piece_start_us
                    values[event] = response + slope * since
                    if cutoff_hz > 0:
                        decay = math.exp(-per_us * since)
                        values[event] += lag * decay - slope * (1 - decay) / per_us
                    event += 1
                if cutoff_hz > 0:
                    decay = math.exp(-per_us * piece_us)
                    lag = lag * decay - slope * (1 - decay) / per_us
                response, light, piece_start_us = response_after, light_after, end_us
            before, after, tangent = after, beyond, next_tangent
    return values
