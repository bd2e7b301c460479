"""Event-camera emulation: light on the channels of one sensor in, events and the sensor's state out."""

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Protocol

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, Shaped
from pydantic import Field, PositiveFloat
from torch import Tensor

from polarnet.events.stream import Events, concatenate
from polarnet.runtime.arrays import Array, as_tensor, check_finite, check_range, check_shape
from polarnet.runtime.compilation import forget_stale_code
from polarnet.runtime.machine import generator_for
from polarnet.runtime.sections import one_of, section
from polarnet.simulation.pixels import esim, exact, v2e, voltmeter
from polarnet.simulation.pixels.columns import MAX_STEP_US, MAX_TIME_US, Columns, Steps, defects_of, empty_columns
from polarnet.simulation.pixels.light import FULL_SCALE, Light
from polarnet.simulation.pixels.physics import MAX_RATE_HZ, PixelConfig, physics_of

EVENTS_PER_PIXEL_AND_STEP = 0.5  # initial room, far more than usual: untouched pages cost no memory
MAX_INITIAL_ROOM = 1 << 22  # events; columns grow where a scene is busier


class PixelModel(Protocol):
    """A pixel model: a module of `polarnet.simulation.pixels`."""

    EIGHT_BIT_VIDEO: bool  # whether the model sees whole digital numbers at regular times

    def start(self, light: Light, steps: Steps) -> Any:
        """A channel's pixels, mismatch included, adapted to the first frame: a NamedTuple of arrays [h * w]."""

    def advance(self, light: Light, pixels: Any, steps: Steps, columns: Columns) -> tuple[Columns, int]:
        """Advance the pixels through the steps, in place; return the columns with the events, and their number.

        A compiled kernel."""


PARTIAL: dict[str, tuple[Any, tuple[str, ...]]] = {
    "dark_dn": (None, ("v2e", "exact")),
    "photoreceptor_noise": (0.0, ("v2e", "exact")),
    "refractory": ("keep", ("exact",)),
}
"""Parameters that only some models have: the value that switches one off, which others insist on, and its models."""
LOGARITHMIC = "_hz"
"""Name suffix of the parameters whose logarithm is drawn uniformly: rates and bandwidths."""
NAMES = ("model", "refractory")
"""Parameters that are one of several names, each listed name as likely as the others."""
MODELS: dict[str, PixelModel] = {"v2e": v2e, "exact": exact, "esim": esim, "dvs_voltmeter": voltmeter}


@section
class EmulatorConfig(PixelConfig):
    """Section `emulate` of params.yaml: the parameters of all pixel models, and which model is in use.

    A model ignores the parameters that it does not have, and refuses those in `PARTIAL`. Ranges in `randomise` are
    drawn before (`Camera.drawn`).

    >>> from dataclasses import replace
    >>> from polarnet.simulation import SENSORS
    >>> replace(SENSORS["default"], contrast_threshold_on=0.15).contrast_threshold_on
    0.15
    """

    model: Annotated[str, one_of(MODELS)]
    render_rate_hz: PositiveFloat | None
    """Rate at which the light is rendered; null: one frame for each pixel of motion."""
    hot_pixel_share: Annotated[float, Field(ge=0, le=1)]
    """Probability that a pixel is hot: it fires at random times, whatever its light, in every model."""
    hot_pixel_rate_hz: Annotated[float, Field(ge=0, le=MAX_RATE_HZ)]
    """Events per second of a hot pixel, ON and OFF together; 0: it is dead."""
    randomise: dict[str, list[float | str]] | None
    """Draws of each sequence: [lowest, highest] of a number, or the names that a parameter of `NAMES` may take.

    A name that is listed twice is drawn twice as often. null: nothing is drawn.
    """

    def __post_init__(self):
        super().__post_init__()
        _check_ranges(self)
        for name, (off, having) in PARTIAL.items():
            value = getattr(self, name)
            if value != off and self.model not in having:
                raise ValueError(
                    f"{name}: expected {off} with model {self.model}, got {value}; models with it: {', '.join(having)}"
                )


def _check_ranges(config: EmulatorConfig) -> None:
    """ValueError for ranges that are not ranges, or beyond those of their parameter."""
    drawable = [name for name, value in vars(config).items() if name in NAMES or not isinstance(value, str)]
    drawable.remove("randomise")
    ranges: dict[str, Any] = config.randomise or {}
    for name, values in ranges.items():
        if name not in drawable:
            raise ValueError(f"randomise.{name}: expected one of {', '.join(drawable)}, got {name!r}")
        pair = len(values) == 2 and all(isinstance(value, float) for value in values) and values[0] <= values[1]
        if not (values if name in NAMES else pair):
            form = "at least one name" if name in NAMES else "[lowest, highest]"
            raise ValueError(f"randomise.{name}: expected {form}, got {values}")
        if name.endswith(LOGARITHMIC) and values[0] <= 0:
            raise ValueError(f"randomise.{name}: expected a lowest value > 0, got {values}; the logarithm is drawn")
        for value in values:
            try:
                replace(config, randomise=None, **{name: value})
            except ValueError as error:
                raise ValueError(f"randomise.{error}") from None


def draws(config: EmulatorConfig, seed: int, sequence: str) -> dict[str, Any]:
    """Values that a sequence draws from `randomise`, by parameter.

    A draw depends only on seed, sequence, parameter and range, so that other ranges do not change it.
    """
    values: dict[str, Any] = {}
    ranges: dict[str, Any] = config.randomise or {}
    for name, listed in ranges.items():
        generator = generator_for(seed, sequence, name)
        if name in NAMES:
            values[name] = listed[int(generator.integers(len(listed)))]
            continue
        lowest, highest = listed
        if name.endswith(LOGARITHMIC):
            values[name] = math.exp(generator.uniform(math.log(lowest), math.log(highest)))
        else:
            values[name] = generator.uniform(lowest, highest)
    return values


@dataclass(frozen=True)
class SensorState:
    """State of a sensor after its last frame; hand it back to continue from there.

    >>> import torch
    >>> from polarnet.simulation import SENSORS, emulate
    >>> _, state = emulate(torch.zeros(2, 4, 8, 8), torch.tensor([0, 1000]), SENSORS["clean"], key=1)
    >>> state.t_us
    1000.0
    """

    model: str
    height: int
    width: int
    pixels: tuple[Any, ...]  # state arrays of each channel, as the model's module defines them
    t_us: float  # time of the last frame
    steps: int  # number of frames after the first; random draws are numbered by it


class Channels(NamedTuple):
    """Channels of one kind of sensor."""

    height: int
    width: int
    sensor: EmulatorConfig
    key: int  # modulo 2^64, seeds all noise; each channel draws its mismatch and noise by its place


def emulate(
    frames: Shaped[Array, "n channels h w"],
    t_us: Int64[Array, " m"] | Float64[Array, " m"],
    config: EmulatorConfig,
    key: int,
    state: SensorState | None = None,
    threads: int = 1,
) -> tuple[list[Events], SensorState]:
    """Events of each channel of a sensor that sees `frames` at times `t_us`, and the sensor's state after them.

    Frames are uint8, or float in digital numbers 0..255. Without a state, the pixels adapt to the first frame, which
    fires no event; a clip cut into pieces, each given the state of the previous one, gives the events of the whole
    clip. `key`, modulo 2^64, seeds all noise, which each channel draws by its place. Events are in the order
    (t, y, x, p), and identical for any number of threads. TypeError for anything but an array; ValueError for times
    that do not increase, are beyond 2^53 us or more than 71 minutes apart, values that are not finite or outside
    0..255, and sizes that do not fit.

    >>> import torch
    >>> from polarnet.simulation import SENSORS, emulate
    >>> frames = torch.stack([torch.full((4, 8, 8), level) for level in (50.0, 200.0)])
    >>> events, state = emulate(frames, torch.tensor([0, 1000]), SENSORS["clean"], key=1)
    >>> events[0].p.unique()
    tensor([1], dtype=torch.int8)
    """
    frames = as_tensor("frames", frames).detach().cpu()
    check_shape("frames", frames, "... channels height width")
    times = np.asarray(t_us, dtype=np.float64)
    _check_frames(frames, times, state, config.model)
    clip = frames.numpy() if frames.dtype == torch.uint8 else frames.to(torch.float32).numpy()
    lights = [Light(np.ascontiguousarray(channel)) for channel in clip.swapaxes(0, 1)]
    height, width = clip.shape[2:]
    return emulate_lights(Channels(height, width, config, key), lights, times, state, threads)


def emulate_frames(
    channels: Channels,
    pieces: Iterable[tuple[Int64[np.ndarray, " n"], Float32[np.ndarray, "channels n h w"]]],
    state: SensorState | None = None,
    threads: int = 1,
) -> tuple[list[Events], SensorState]:
    """As `emulate`, for times and light in DN that come in pieces.

    Models of 8-bit video see it rounded, unless `dark_dn` asks for light below 1 DN.
    """
    parts, sensor = [], channels.sensor
    for t_us, light in pieces:
        if MODELS[sensor.model].EIGHT_BIT_VIDEO and sensor.dark_dn is None:
            light = (light + np.float32(0.5)).astype(np.uint8)
        lights = [Light(np.ascontiguousarray(channel)) for channel in light]
        events, state = emulate_lights(channels, lights, t_us.astype(np.float64), state, threads)
        parts.append(events)
    assert state is not None  # there was at least one piece
    return [concatenate(channel) for channel in zip(*parts, strict=True)], state


def emulate_lights(
    channels: Channels,
    lights: Sequence[Light],
    t_us: Float64[np.ndarray, " n"],
    state: SensorState | None = None,
    threads: int = 1,
) -> tuple[list[Events], SensorState]:
    """Events of channels under `lights` at times `t_us`, and the state after them; `threads` channels run at once."""
    forget_stale_code(Path(__file__).parent)
    height, width, config, key = channels
    model = MODELS[config.model]
    physics, seed = physics_of(config), np.uint64(key % 2**64)
    times = _checked_times(t_us if state is None else np.concatenate([[state.t_us], t_us]))
    first_frame, first_number = (1, 0) if state is None else (0, state.steps)
    room = 1 + int(min(MAX_INITIAL_ROOM, EVENTS_PER_PIXEL_AND_STEP * height * width * len(times)))
    # allocated here, because glibc returns what other threads allocate to the system as soon as they end
    empty = [empty_columns(room) for _ in lights]

    def emulate_channel(i: int) -> tuple[list[Tensor], Any]:
        defects = defects_of(config.hot_pixel_share, config.hot_pixel_rate_hz, height * width, seed, i, model is v2e)
        steps = Steps(physics, height, width, times, first_frame, first_number, seed, i, defects)
        if state is None:
            pixels = model.start(lights[i], steps)
        else:
            pixels = type(state.pixels[i])(*(array.copy() for array in state.pixels[i]))
        columns, count = model.advance(lights[i], pixels, steps, empty[i])
        return [torch.from_numpy(column[:count]) for column in columns], pixels

    with ThreadPoolExecutor(threads) as pool:
        channel_map = pool.map if threads > 1 else map
        columns, pixels = zip(*channel_map(emulate_channel, range(len(lights))), strict=True)
    events = [Events(t, x, y, p, height, width) for t, x, y, p in columns]
    steps_taken = first_number + len(times) - 1
    return events, SensorState(config.model, height, width, pixels, float(times[-1]), steps_taken)


def _checked_times(times: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """The times of frames, the last one of the state before them included.

    ValueError for NaN, times beyond 2^53 us, times that do not increase, and steps of more than 2^32 us (71 minutes).
    """
    wrong, steps = ~(np.abs(times) <= MAX_TIME_US), np.diff(times)
    wrong[1:] |= ~(steps > 0)
    if wrong.any():
        k = int(wrong.argmax())
        raise ValueError(
            f"emulate: expected strictly increasing times in us, of at most 2^53, got {times[max(k - 2, 0) : k + 1]}"
        )
    if len(steps) and steps.max() > MAX_STEP_US:
        k = int(steps.argmax())
        raise ValueError(
            f"emulate: expected at most {MAX_STEP_US * 1e-6:.0f} s from one frame to the next, got {steps[k] * 1e-6:g} "
            f"s after {times[k]} us; insert frames, or scale the times down"
        )
    return times


def _check_frames(frames: Tensor, times: Float64[np.ndarray, " m"], state: SensorState | None, model: str) -> None:
    if frames.ndim != 4 or len(frames) != len(times) or len(times) == 0:
        raise ValueError(
            f"emulate: expected frames (n, channels, h, w) with one time each and at least one frame, "
            f"got frames {tuple(frames.shape)} and {len(times)} times"
        )
    if frames.dtype != torch.uint8:
        if not frames.is_floating_point():
            raise ValueError(f"emulate: expected frames as uint8 or float digital numbers (0..255), got {frames.dtype}")
        check_finite("frames", frames)
        check_range("frames", frames, 0, FULL_SCALE, "digital numbers", f"scale white to {FULL_SCALE:g}")
    if state is not None:
        theirs = f"model {state.model}, {len(state.pixels)} channels of {state.height}x{state.width} pixels"
        ours = f"model {model}, {frames.shape[1]} channels of {frames.shape[2]}x{frames.shape[3]} pixels"
        if theirs != ours:
            raise ValueError(f"emulate: expected a state of {ours}, got one of {theirs}")
