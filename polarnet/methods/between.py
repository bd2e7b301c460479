"""DoLP between windows: the frame at the end of a window moves with the scene, and every event corrects it.

A network predicts a frame at the end of each window, at the cost of a whole run. Until the next frame, two cheap
sources continue it:

- Motion. The frame keeps moving at the velocity of the events of the last two windows (`panorama.displacements`).
- Events. log I0 - log I90 = 2 atanh(s1) and log I45 - log I135 = 2 atanh(s2), so an event of threshold c changes
  atanh(s1) or atanh(s2) of its pixel by c / 2.

The events of single pixels are noisy, because thresholds differ between pixels. The change that they count therefore
replaces the change that the motion predicts only in part (`BetweenConfig.share`), after a mean over neighbours.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Float
from pydantic import Field, PositiveFloat
from torch import Tensor
from torch.nn import functional as F

from polarnet.events.representations import event_counts
from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import EventWindow
from polarnet.networks.polarnet.panorama import displacements
from polarnet.networks.polarnet.redundancy import box_means
from polarnet.networks.polarnet.refinement import MAX_DOLP
from polarnet.runtime.sections import section
from polarnet.stokes import Prediction

CHANNELS = ((0, 1), (1, 1), (0, -1), (1, -1))
"""For each channel, the row of (atanh s1, atanh s2) that its events change, and the sign for an ON event."""


@section
class BetweenConfig:
    """Section `between` of params.yaml: frames between windows (`polarnet recover --rate`)."""

    reach: Annotated[int, Field(gt=0, le=1000)]
    """Search range for the scene's motion per window, pixels along each axis; also a frame's largest displacement."""
    share: Annotated[float, Field(ge=0, le=1)]
    """Weight of the change that events count, against the change that the motion predicts; 0: motion alone."""
    width: Annotated[int, Field(gt=0, le=1000)]
    """Width in pixels of the neighbourhood over which the difference of the two is averaged, odd."""
    threshold_on: PositiveFloat
    """Mean contrast thresholds of the camera, natural-log intensity."""
    threshold_off: PositiveFloat

    def __post_init__(self):
        if self.width % 2 == 0:
            raise ValueError(f"width: expected an odd number of pixels, got {self.width}")

    def with_thresholds(self, thresholds: Sequence[float] | None) -> "BetweenConfig":
        """Settings for a camera of these contrast thresholds, ON and OFF; None: unchanged."""
        if thresholds is None:
            return self
        return dataclasses.replace(self, threshold_on=thresholds[0], threshold_off=thresholds[1])


class Between(NamedTuple):
    """State between windows: the frame at the end of the latest window, its velocity, and the events since."""

    window: EventWindow
    """The window, whose events the next search of the motion needs."""
    prediction: Prediction
    """The frame at its end, on the CPU."""
    velocity: Float[Tensor, " 2"]
    """(x, y) in pixels per microsecond, 0 unless events confirm a motion: the point now at p was at p + velocity * t, t
    microseconds ago."""
    maps: Float[Tensor, "c h2 w2"]
    """DoLP, log-variance if predicted, atanh(s1) and atanh(s2) if AoLP is; the border is repeated `reach` + 1 times."""
    change: Float[Tensor, "2 h w"]
    """Change of atanh(s1) and atanh(s2) since the end of the window, counted by the events."""
    t_us: int
    """Time up to which events are counted."""


def anchored(before: Between | None, window: EventWindow, prediction: Prediction, config: BetweenConfig) -> Between:
    """State at the end of a window, whose frame is `prediction`; `before` is the state of the previous window."""
    maps = [prediction.dolp.float()[None]]
    if prediction.log_variance is not None:
        maps.append(prediction.log_variance.float()[None])
    stokes = prediction.stokes
    if stokes is None and prediction.aolp is not None:
        stokes = prediction.dolp * torch.stack([torch.cos(2 * prediction.aolp), torch.sin(2 * prediction.aolp)])
    if stokes is not None:
        maps.append(torch.atanh(stokes.float().clamp(-MAX_DOLP, MAX_DOLP)))
    beyond = config.reach + 1
    padded = F.pad(torch.cat(maps)[None], (beyond, beyond, beyond, beyond), mode="replicate")[0]
    velocity = torch.zeros(2) if before is None else _velocity(before.window, window, config.reach)
    return Between(window, prediction, velocity, padded, torch.zeros(2, *prediction.dolp.shape), window.stop_us)


def carried(state: Between, channels: Sequence[Events], t_us: int, config: BetweenConfig) -> tuple[Between, Prediction]:
    """State and frame at `t_us`, no earlier than the time of the state; only events between the two times count.

    Let u be (atanh s1, atanh s2) at the end of the window, u(p + d) the same moved by the displacement d, and e the
    change counted by events. Then u(p + d) + share * mean(e - (u(p + d) - u(p))) is the frame at p. DoLP moves too, and
    changes as much as the length of (s1, s2). A frame without AoLP only moves. At the end of the window, the frame is
    the method's own.
    """
    change = _counted(state.change, [slice_time(events, state.t_us, t_us) for events in channels], config)
    state = state._replace(change=change, t_us=t_us)
    elapsed_us = t_us - state.window.stop_us
    if elapsed_us == 0:
        return state, state.prediction
    beyond = config.reach + 1
    displacement = (state.velocity * elapsed_us).clamp(-config.reach, config.reach)
    moved = _shifted(state.maps, displacement.tolist(), beyond)
    dolp, log_variance = moved[0], None if state.prediction.log_variance is None else moved[1]
    if state.prediction.aolp is None:
        return state, Prediction(dolp, None, log_variance)
    along = moved[-2:]
    unexplained = change - (along - _shifted(state.maps[-2:], (0.0, 0.0), beyond))
    stokes = torch.tanh(along + config.share * box_means(unexplained[None], config.width)[0])
    dolp = dolp + torch.hypot(*stokes) - torch.hypot(*torch.tanh(along))
    aolp = torch.remainder(torch.atan2(stokes[1], stokes[0]) / 2, math.pi)
    return state, Prediction(dolp.clamp(0, 1), aolp, log_variance, stokes)


def _velocity(before: EventWindow, window: EventWindow, reach: int) -> Float[Tensor, " 2"]:
    """Velocity between the middles of two windows in pixels per microsecond; 0 unless their correlation confirms it."""
    images = torch.stack([_polarity(one) for one in (before, window)])
    motion = displacements(images[:, None], reach)
    apart_us = (window.start_us + window.stop_us - before.start_us - before.stop_us) / 2
    return torch.where(motion.reliable[0], motion.displacement[0, 0] / apart_us, 0.0)


def _polarity(window: EventWindow) -> Float[Tensor, "h w"]:
    """Sum of polarities of the four channels."""
    return torch.stack([event_counts(events, window.length_us)[0] for events in window.channels]).sum(0)


def _counted(
    change: Float[Tensor, "2 h w"], channels: Sequence[Events], config: BetweenConfig
) -> Float[Tensor, "2 h w"]:
    """`change` of atanh(s1) and atanh(s2) plus the change from further events of the four channels."""
    change = change.clone()
    for events, (row, sign) in zip(channels, CHANNELS, strict=True):
        step = torch.where(events.p > 0, config.threshold_on, -config.threshold_off)
        change[row].view(-1).index_add_(0, events.y.long() * events.width + events.x.long(), sign / 2 * step)
    return change


def _shifted(padded: Float[Tensor, "c h2 w2"], displacement: Sequence[float], beyond: int) -> Float[Tensor, "c h w"]:
    """Values at p + displacement (x, y), bilinear between pixels, without the `beyond` pixels around the image."""
    x, y = displacement
    left, top = math.floor(x), math.floor(y)
    height, width = (size - 2 * beyond for size in padded.shape[-2:])
    part = padded[:, beyond + top :, beyond + left :]
    if x != left:
        part = torch.lerp(part[..., :width], part[..., 1 : width + 1], x - left)
    if y != top:
        part = torch.lerp(part[:, :height], part[:, 1 : height + 1], y - top)
    return part[:, :height, :width]
