"""DoLP and AoLP of one camera behind a rotating polarizer, from each half turn in closed form.

Within half a turn the light behind the polarizer goes through one period. The sum of a pixel's events times their
contrast thresholds follows the logarithm of that light, so that its exponential y is linear in three unknowns:

    y = a + b cos 2 theta + c sin 2 theta,    DoLP = sqrt(b^2 + c^2) / a,    AoLP = atan2(c, b) / 2.

Least squares of the relative residuals (weights 1 / y^2) solve each pixel alone. The thresholds and the bandwidth are
taken as known.
"""

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64, Int64
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor

from polarnet.events.rotation import Rotation
from polarnet.events.stream import Events, concatenate, merge, slice_time
from polarnet.events.streaming import EventWindow
from polarnet.methods.method import Method, Recoverer, Setup
from polarnet.runtime.compilation import compiled
from polarnet.runtime.sections import section
from polarnet.simulation.pixels.physics import DARK_OFFSET, SATURATION
from polarnet.stokes import Prediction

MIN_EVENTS = 3  # as many as there are unknowns
PIVOT_MIN = 1e-12


@section
class RotatingPolarizerConfig:
    """Section `methods.rotating_polarizer` of params.yaml."""

    threshold_on: PositiveFloat
    """Mean contrast thresholds of the camera, in natural-log intensity."""
    threshold_off: PositiveFloat
    cutoff_hz: NonNegativeFloat
    """Bandwidth of the photoreceptor at full brightness, as in section `emulate`; 0: infinite."""
    level_dn: PositiveFloat
    """Typical mean light behind the polarizer, 0 to 255 DN, which sets the bandwidth that the fit expects."""
    ridge: PositiveFloat
    """Prior precision of b / a and c / a, relative to the sum of the weights."""
    silent_dolp: Annotated[float, Field(ge=0, le=1)]
    """DoLP of a pixel with fewer than three events in half a turn."""
    spread_window: Annotated[int, Field(ge=1, le=1000)]
    """Side in pixels, odd, of the square around a pixel in which the variance of DoLP gives the expected error."""
    spread_scale: PositiveFloat
    """Expected squared error of DoLP over that variance."""
    variance_floor: PositiveFloat
    """Smallest expected squared error of DoLP."""

    def __post_init__(self):
        if self.spread_window % 2 == 0:
            raise ValueError(f"spread_window: expected an odd number of pixels, got {self.spread_window}")

    def lag(self, rotation: Rotation) -> complex:
        """Response of the photoreceptor to the modulation: its gain, and its delay as the (negative) phase."""
        if self.cutoff_hz == 0:
            return 1.0 + 0.0j
        cutoff_hz = self.cutoff_hz * (self.level_dn + DARK_OFFSET) / SATURATION
        return 1 / complex(1, 2 * abs(rotation.rate_hz) / cutoff_hz)


def fit_half_turn(
    events: Events, rotation: Rotation, stop_us: int, config: RotatingPolarizerConfig
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """DoLP, AoLP and log-variance of DoLP at `stop_us`, from the events of the half turn before it.

    A pixel with fewer than three events gets `silent_dolp` and AoLP 0. The variance is that of DoLP over the
    neighbouring pixels: where the scene moves, errors are as large as DoLP differs there, and noise shows there too.
    """
    recent = slice_time(events, math.floor(stop_us - rotation.half_turn_us), stop_us)
    size = events.height, events.width
    pixel = recent.y.numpy().astype(np.int64) * events.width + recent.x.numpy()
    lag = config.lag(rotation)
    delay = math.copysign(float(np.angle(lag)), -rotation.rate_hz)  # events lag, so they show an earlier angle
    phase = 2 * rotation.at(recent.t.numpy()) + delay
    step = np.where(recent.p.numpy() > 0, config.threshold_on, -config.threshold_off)
    fitted = _fit(pixel, np.cos(phase), np.sin(phase), step, events.height * events.width, config.ridge)
    s1, s2 = (torch.from_numpy(one).float().view(size) / abs(lag) for one in fitted[:2])
    silent = torch.from_numpy(fitted[2]).view(size) < MIN_EVENTS
    dolp = torch.where(silent, config.silent_dolp, torch.hypot(s1, s2).clamp(max=1))
    aolp = torch.where(silent, 0.0, torch.atan2(s2, s1) / 2 % math.pi)
    variance = config.spread_scale * local_variance(dolp, config.spread_window) + config.variance_floor
    return dolp, torch.where(aolp >= math.pi, 0.0, aolp), variance.log()


def local_variance(frame: Float[Tensor, "h w"], side: int) -> Float[Tensor, "h w"]:
    """Variance over the square of `side` pixels around each pixel, cut off at the border."""
    moments = torch.stack([frame.double(), frame.double().square()])[None]
    mean, square = F.avg_pool2d(moments, side, 1, side // 2, count_include_pad=False)[0]
    return (square - mean.square()).clamp(min=0).float()


def open_rotating(setup: Setup) -> Recoverer:
    """Wrap the fit as a method; the events may be in any channel, the others are empty."""
    config, rotation = setup.config, setup.rotation
    assert rotation is not None, "the method needs the rotation of the polarizer"

    def predict(recent: Events, windows: Sequence[EventWindow]) -> tuple[Events, Prediction]:
        maps = []
        for window in windows:
            recent = concatenate([recent, merge(window.channels)])
            maps.append(fit_half_turn(recent, rotation, window.stop_us, config))
            recent = slice_time(recent, math.floor(window.stop_us - rotation.half_turn_us), window.stop_us)
        return recent, Prediction(*(torch.stack(one) for one in zip(*maps, strict=True)))

    return Recoverer(Events.empty, predict)


@compiled
def _fit(
    pixel: Int64[np.ndarray, " n"],
    cos: Float64[np.ndarray, " n"],
    sin: Float64[np.ndarray, " n"],
    step: Float64[np.ndarray, " n"],
    count: int,
    ridge: float,
) -> Float64[np.ndarray, "3 count"]:
    """b / a, c / a and the number of events of each pixel, from events in time order."""
    level = np.zeros(count)  # sum of a pixel's steps since its first event
    sums = np.zeros((count, 9))  # sums of w (1, cos, sin, cos cos, cos sin, sin sin) and 1 / y (cos, sin, 1)
    fitted = np.zeros((3, count))
    for k in range(len(pixel)):
        i, c, s = pixel[k], cos[k], sin[k]
        if fitted[2, i] > 0:
            level[i] += step[k]
        fitted[2, i] += 1
        inverse = math.exp(-level[i])  # 1 / y
        w = inverse * inverse
        for j, term in enumerate((w, w * c, w * s, w * c * c, w * c * s, w * s * s, inverse * c, inverse * s, inverse)):
            sums[i, j] += term
    for i in range(count):
        if fitted[2, i] < MIN_EVENTS:
            continue
        w, wc, ws, cc, cs, ss, yc, ys, y = sums[i]
        cc, ss = cc + ridge * w, ss + ridge * w
        # eliminate a, then solve the two equations for b and c
        cc, cs, ss = cc - wc * wc / w, cs - wc * ws / w, ss - ws * ws / w
        yc, ys = yc - wc * y / w, ys - ws * y / w
        determinant = max(cc * ss - cs * cs, PIVOT_MIN * cc * ss)
        b, c = (ss * yc - cs * ys) / determinant, (cc * ys - cs * yc) / determinant
        a = (y - wc * b - ws * c) / w
        fitted[0, i], fitted[1, i] = b / a, c / a
    return fitted


METHODS = (
    Method(
        name="rotating_polarizer",
        label="rotating polarizer †",
        colour="#0f766e",
        open=open_rotating,
        config=RotatingPolarizerConfig,
        rotating=True,
        about="One event camera behind a rotating polarizer; a closed-form fit to the events of each half turn gives "
        "DoLP, AoLP and expected errors. It sees the same scenes and motions as the other rows, but other events.",
    ),
)
