"""Event-camera emulation: light on the planes of one sensor in, events and the sensor's state out."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64, Int64, Shaped
from torch import Tensor

from polarnet.arrays import Array, as_tensor, check_range, check_shape
from polarnet.events.stream import Events
from polarnet.ranges import allowed, check_ranges
from polarnet.simulation.pixels import esim, exact, v2e, voltmeter
from polarnet.simulation.pixels.columns import Columns, empty_columns
from polarnet.simulation.pixels.light import FULL_SCALE, Light, light_of_frames
from polarnet.simulation.sharing import PlaneRun, run_planes

EVENTS_PER_PIXEL_AND_STEP = 0.5  # room to begin with, far more than usual: what is not written costs no memory
LARGEST_FIRST_ROOM = 1 << 22  # events; columns grow where a scene is busier


@dataclass(frozen=True)
class EmulatorConfig:
    """Section `emulate` of params.yaml. Contrast thresholds are steps of natural-log intensity.

    A parameter that a model does not have is without effect in it: `esim` has thresholds and the refractory period
    alone, `dvs_voltmeter` the constants of its camera.
    """

    model: str = field(metadata=allowed(choices=["v2e", "exact", "esim", "esim_gpu", "dvs_voltmeter"]))
    render_rate_hz: float | None = field(metadata=allowed(above=0))
    """Frames a second of the light that the pixels see; null: a step for each pixel of motion."""
    contrast_threshold_on: float = field(metadata=allowed(low=0.01, high=10))
    contrast_threshold_off: float = field(metadata=allowed(low=0.01, high=10))
    contrast_threshold_sigma: float = field(metadata=allowed(low=0))
    """Standard deviation between pixels, drawn for each polarizer."""
    cutoff_hz: float = field(metadata=allowed(low=0))
    """Bandwidth of the photoreceptor at full brightness, less in the dark; 0: infinite."""
    leak_rate_hz: float = field(metadata=allowed(low=0))
    """ON events per second of a pixel that sees no change."""
    leak_jitter: float = field(metadata=allowed(low=0, high=1))
    """Relative standard deviation of the leak: in each frame for `v2e`, in each interval of events for `exact`."""
    noise_rate_cov_decades: float = field(metadata=allowed(low=0))
    """Spread of the leak rate between pixels, as a power of ten."""
    shot_noise_rate_hz: float = field(metadata=allowed(low=0))
    """Noise events per second of a pixel in the dark, ON and OFF together; a quarter of it at full brightness."""
    refractory_period_us: float = field(metadata=allowed(low=0))
    esim_log_eps: float = field(metadata=allowed(above=0))
    """Added to intensity in [0, 1] before `esim` takes its logarithm."""
    voltmeter_camera: str = field(metadata=allowed(choices=tuple(voltmeter.CAMERAS)))
    randomise: bool
    """Draw the parameters below anew for each sequence, uniformly (rates and cutoff: in their logarithm)."""
    random_threshold_on: list[float] = field(metadata=allowed(low=0.01, high=10))
    random_threshold_off: list[float] = field(metadata=allowed(low=0.01, high=10))
    random_threshold_sigma: list[float] = field(metadata=allowed(low=0))
    random_cutoff_hz: list[float] = field(metadata=allowed(above=0))
    random_leak_rate_hz: list[float] = field(metadata=allowed(above=0))
    random_shot_noise_rate_hz: list[float] = field(metadata=allowed(above=0))

    def __post_init__(self):
        check_ranges(self)
        for name in (name for name in vars(self) if name.startswith("random_")):
            bounds = getattr(self, name)
            if len(bounds) != 2 or bounds[0] > bounds[1]:
                raise ValueError(f"{name}: expected [lowest, highest], got {list(bounds)}")


def randomised(config: EmulatorConfig, generator: np.random.Generator) -> EmulatorConfig:
    """The configuration of one sequence: `config`, or with values drawn from its ranges if it says `randomise`."""
    if not config.randomise:
        return config

    def between(bounds: list[float]) -> float:
        return float(generator.uniform(bounds[0], bounds[1]))

    def between_in_logarithm(bounds: list[float]) -> float:
        return math.exp(between([math.log(bound) for bound in bounds]))

    return replace(
        config,
        contrast_threshold_on=between(config.random_threshold_on),
        contrast_threshold_off=between(config.random_threshold_off),
        contrast_threshold_sigma=between(config.random_threshold_sigma),
        cutoff_hz=between_in_logarithm(config.random_cutoff_hz),
        leak_rate_hz=between_in_logarithm(config.random_leak_rate_hz),
        shot_noise_rate_hz=between_in_logarithm(config.random_shot_noise_rate_hz),
    )


class PixelModel(NamedTuple):
    """One way in which pixels turn light into events; see the modules of `polarnet.simulation.pixels`."""

    physics: Callable[[EmulatorConfig], Any]
    initial: Callable[[int, int, Any, np.uint64, int], Any]
    start: Callable[..., None]
    advance: Callable[..., tuple[Columns, int]]
    is_video: bool
    """Whether it sees light as a video has it: rounded to whole digital numbers, at regular times."""


def _v2e_physics(config: EmulatorConfig) -> v2e.Physics:
    return v2e.Physics(
        config.contrast_threshold_on,
        config.contrast_threshold_off,
        config.contrast_threshold_sigma,
        config.cutoff_hz,
        config.leak_rate_hz,
        config.leak_jitter,
        config.noise_rate_cov_decades,
        config.shot_noise_rate_hz,
        config.refractory_period_us * 1e-6,
    )


def _esim_physics(config: EmulatorConfig) -> esim.Physics:
    return esim.Physics(
        config.contrast_threshold_on,
        config.contrast_threshold_off,
        config.refractory_period_us,
        config.esim_log_eps,
        config.model == "esim_gpu",
    )


def _voltmeter_physics(config: EmulatorConfig) -> voltmeter.Physics:
    return voltmeter.CAMERAS[config.voltmeter_camera]


_ESIM = PixelModel(_esim_physics, esim.initial, esim.start, esim.advance, is_video=False)
MODELS = {
    "v2e": PixelModel(_v2e_physics, v2e.initial, v2e.start, v2e.advance, is_video=True),
    "exact": PixelModel(_v2e_physics, exact.initial, exact.start, exact.advance, is_video=False),
    "esim": _ESIM,
    "esim_gpu": _ESIM,
    "dvs_voltmeter": PixelModel(
        _voltmeter_physics, voltmeter.initial, voltmeter.start, voltmeter.advance, is_video=False
    ),
}


@dataclass(frozen=True)
class SensorState:
    """Where the pixels of a sensor stand after its last frame; hand it back to go on from there."""

    model: str
    height: int
    width: int
    planes: tuple[int, ...]
    pixels: tuple[Any, ...]
    """State arrays of each plane, as the model's module defines them."""
    t_us: float
    """Time of the last frame."""
    steps: int
    """Frames seen after the first; noise is drawn by their number."""


def emulate(
    frames: Shaped[Array, "n planes h w"],
    t_us: Int64[Array, " m"] | Float64[Array, " m"],
    config: EmulatorConfig,
    key: int,
    state: SensorState | None = None,
    planes: Sequence[int] | None = None,
    threads: int = 1,
) -> tuple[list[Events], SensorState]:
    """Events of each plane of a sensor that sees `frames` (uint8, or float in digital numbers 0..255) at times `t_us`.

    The first frame after `state=None` fires nothing: it is what the pixels have adapted to. A clip cut into pieces,
    each given the state that the one before returned, gives the events of the whole. `key` (64 bits) seeds all noise;
    `planes` are the numbers by which the planes draw their own mismatch and noise, 0, 1, ... by default. Events are in
    the order (t, y, x, p), and the same to the last bit for any number of threads and any order of planes.
    Frames and times may be numpy or torch. TypeError for what is no array; ValueError for times that do not increase,
    values that are not finite or outside 0..255, and sizes that do not fit.
    """
    columns, state = emulate_columns(frames, t_us, config, key, state, planes, threads)
    return [events_of(c, state.height, state.width) for c in columns], state


def emulate_columns(
    frames: Shaped[Array, "n planes h w"],
    t_us: Int64[Array, " m"] | Float64[Array, " m"],
    config: EmulatorConfig,
    key: int,
    state: SensorState | None = None,
    planes: Sequence[int] | None = None,
    threads: int = 1,
    labels: bool = False,
    exact: bool = False,
) -> tuple[list[Columns], SensorState]:
    """As `emulate`, in numpy columns, with each event's process (`labels`) and time before rounding (`exact`)."""
    frames = as_tensor("frames", frames).detach().cpu()
    check_shape("frames", frames, "... planes height width")
    planes = tuple(range(frames.shape[-3])) if planes is None else tuple(planes)
    times = np.asarray(t_us, dtype=np.float64)
    _check_frames(frames, times, planes, state, config.model)
    clip = frames.numpy() if frames.dtype == torch.uint8 else frames.to(torch.float32).numpy()
    lights = [light_of_frames(np.ascontiguousarray(clip[:, i])) for i in range(len(planes))]
    height, width = frames.shape[2:]
    return run(lights, times, height, width, config, key, state, planes, threads, labels, exact)


def run(
    lights: Sequence[Light],
    t_us: Float64[np.ndarray, " n"],
    height: int,
    width: int,
    config: EmulatorConfig,
    key: int,
    state: SensorState | None,
    planes: tuple[int, ...],
    threads: int = 1,
    labels: bool = False,
    exact: bool = False,
) -> tuple[list[Columns], SensorState]:
    """Events of planes under `lights` at times `t_us`, and the state after them; planes are shared among threads."""
    model = MODELS[config.model]
    physics, seed = model.physics(config), np.uint64(key)
    times, steps = (t_us, 0) if state is None else (np.concatenate([[state.t_us], t_us]), state.steps)
    room = 1 + int(min(LARGEST_FIRST_ROOM, EVENTS_PER_PIXEL_AND_STEP * height * width * len(times)))

    def begin(i: int) -> Any:
        if state is not None:
            return type(state.pixels[i])(*(array.copy() for array in state.pixels[i]))
        new = model.initial(height, width, physics, seed, planes[i])
        model.start(lights[i], new, physics, height, width, times[0], seed, planes[i])
        return new

    def plane_run(i: int) -> PlaneRun:
        def advance(start: int, stop: int, columns: Columns) -> tuple[Columns, int]:
            if start == 0:
                pixels[i] = begin(i)
            offset = start + (1 if state is None else 0)  # without a state, the first of the lights is that of `begin`
            return model.advance(
                lights[i], offset, pixels[i], physics, height, width, times[start : stop + 1], steps + start,
                seed, planes[i], columns,
            )  # fmt: skip

        # room made here: what other threads allocate, glibc hands back to the system as soon as they end
        return PlaneRun(advance, empty_columns(room, labels, exact))

    pixels: list[Any] = [None] * len(planes)
    runs = [plane_run(i) for i in range(len(planes))]
    run_planes(runs, times, threads)
    after = SensorState(config.model, height, width, planes, tuple(pixels), float(times[-1]), steps + len(times) - 1)
    return [plane.events for plane in runs], after


def events_of(columns: Columns, height: int, width: int) -> Events:
    """The columns as events; shares their memory."""
    t, x, y, p = (torch.from_numpy(column) for column in columns[:4])
    return Events(t, x, y, p, height, width)


def _check_frames(
    frames: Tensor, times: Float64[np.ndarray, " m"], planes: tuple[int, ...], state: SensorState | None, model: str
) -> None:
    if frames.ndim != 4 or len(frames) != len(times) or len(times) == 0:
        raise ValueError(
            f"emulate: expected frames (n, planes, h, w) with one time each and at least one frame, "
            f"got frames {tuple(frames.shape)} and {len(times)} times"
        )
    if frames.dtype != torch.uint8 and not frames.is_floating_point():
        raise ValueError(f"emulate: expected frames as uint8 or float digital numbers (0..255), got {frames.dtype}")
    if frames.dtype != torch.uint8 and not (torch.isfinite(frames).all() and (frames >= 0).all()):
        raise ValueError("emulate: expected finite frames >= 0, got NaN, infinite or negative values")
    if frames.dtype != torch.uint8:
        check_range("frames", frames, 0, FULL_SCALE, "digital numbers", f"scale white to {FULL_SCALE:g}")
    if len(set(planes)) != frames.shape[1]:
        raise ValueError(f"emulate: expected {frames.shape[1]} different plane numbers, one a plane, got {planes}")
    before = times if state is None else np.concatenate([[state.t_us], times])
    if not (np.isfinite(before).all() and (np.diff(before) > 0).all()):
        raise ValueError(
            "emulate: expected strictly increasing times in microseconds"
            + ("" if state is None else f", the first after the state's {state.t_us}")
            + f", got {times[:5].tolist()}..."
        )
    if state is not None and state.model != model:
        raise ValueError(f"emulate: the state is of model {state.model}, the configuration of {model}")
    if state is not None and (*state.planes, state.height, state.width) != (*planes, *frames.shape[2:]):
        raise ValueError(
            f"emulate: the state is of planes {state.planes} of {state.height}x{state.width} pixels, "
            f"the frames are of planes {planes} of {frames.shape[2]}x{frames.shape[3]}"
        )
