"""The DoLP network over a whole recording: its maps and one panorama of all events, joined.

The network sees the past alone and forgets. `register` compares all windows of a recording with each other, which gives
the pattern of atanh(s1) and atanh(s2), but no constants. The network's maps, averaged along the motion, give these.
A panorama shows a scene that moves as one plane; so does a camera that turns.

Where the camera takes frames too, such as a PDAVIS, these give (s1, s2) instead: their mean along the motion shows
every window what any frame of the block saw.

Blocks of `windows` windows are registered together with `overlap` earlier ones, so a recording may have any length.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional as F

from polarnet.events.representations import event_counts
from polarnet.events.streaming import EventWindow
from polarnet.methods.dolp_network import METHODS as NETWORKS
from polarnet.methods.method import Method, Recoverer, Setup, State, each_map, joined
from polarnet.methods.registration import (
    NEAR,
    Panorama,
    RegistrationConfig,
    at_rest,
    mosaic,
    offset_field,
    register,
    unexplained,
    views,
)
from polarnet.stokes import Prediction, StokesFrames

FEWEST = 8  # windows in which a panorama can be found
MAX_S = 0.98  # limit of s1 and s2, so that atanh is finite
MISPLACED = 0.2  # share of the variance of single frames that a mean of many keeps, as where the motion is not exact
SMALLEST_VARIANCE = 1e-5  # of DoLP from frames, such as that of 8 bits

OURS = next(method for method in NETWORKS if method.name == "ours")


class Past(NamedTuple):
    """State before a block of windows: that of the network, and what it was given and predicted in the latest ones."""

    inner: State
    counts: Float[Tensor, "k 8 h w"]
    predicted: Prediction | None
    """Maps of the same k windows; None before the first."""
    steps: Float[Tensor, " k"]
    """Estimated change of log intensity per event in each of them."""
    edges_us: Int64[np.ndarray, " k1"]
    """Start of the first window and ends of all; empty before the first."""


def open_registered(setup: Setup) -> Recoverer:
    """Open the network from the checkpoint in the setup, for whole recordings."""
    inner, config = OURS.open(setup), setup.registration
    network: Any = inner.network
    scales: list[Tensor] = []
    network.scale.register_forward_hook(lambda module, features, scale: scales.append(scale.flatten().cpu()))

    def start(height: int, width: int) -> Past:
        nothing = torch.zeros(0, 8, height, width)
        return Past(inner.start(height, width), nothing, None, torch.zeros(0), np.zeros(0, np.int64))

    def predict(past: Past, windows: Sequence[EventWindow]) -> tuple[Past, Prediction]:
        scales.clear()
        state, parts = past.inner, []
        at_once = inner.at_once(*past.counts.shape[-2:])
        for k in range(0, len(windows), at_once):
            state, part = inner.step(state, windows[k : k + at_once])
            parts.append(part)
        own = joined(parts)
        counts = torch.stack([torch.cat([event_counts(one, window.length_us) for one in window.channels]).cpu()
                              for window in windows])  # fmt: skip
        steps = network.step * torch.cat(scales).float().mean().expand(len(windows))
        together = own if past.predicted is None else joined([past.predicted, own])
        edges_us = past.edges_us if past.predicted is not None else np.array([windows[0].start_us])
        edges_us = np.append(edges_us, [window.stop_us for window in windows])
        known = Past(state, torch.cat([past.counts, counts]), together, torch.cat([past.steps, steps]), edges_us)
        new = registered(known, config, setup.frames)
        latest = slice(max(0, len(known.counts) - config.overlap), None)
        predicted = each_map(together, lambda maps: maps[latest])
        kept = Past(state, known.counts[latest], predicted, known.steps[latest], edges_us[latest])
        return kept, own if new is None else each_map(new, lambda maps: maps[-len(windows) :].to(own.dolp.device))

    return Recoverer(start, predict, network=network, at_once=lambda height, width: config.windows, sees_ahead=True)


def registered(known: Past, config: RegistrationConfig, frames: StokesFrames | None = None) -> Prediction | None:
    """Join the network's maps with the panorama of the same windows; None if the scene moves too little for one.

    With s the joined (s1, s2), DoLP^2 is |s|^2 plus the variance of the network's own (s1, s2) along the motion. The
    network's DoLP is its expectation, so its average vectors are shorter than that. Where the panorama does not explain
    the events, the network's maps stay.

    With frames in this time, s is their mean along the motion where they show the scene. Where the panorama does not
    explain the events, the nearest frame takes the place of the network's maps.
    """
    polarity, number = known.counts.unflatten(1, (4, 2)).permute(2, 1, 0, 3, 4).numpy()
    counts = np.stack([number + polarity, number - polarity], axis=1) / 2
    panorama = register(counts, config) if len(counts[0, 0]) >= FEWEST else None
    frames = frames and frames.between(int(known.edges_us[0]), int(known.edges_us[-1]))
    if frames is not None and not len(frames.t_us):
        frames = None
    if panorama is None and frames is None:
        return None
    assert known.predicted is not None
    height, width = number.shape[-2:]
    own = _maps_of(*(field.cpu().float() for field in known.predicted[:3] if field is not None))
    joint = own
    if panorama is None:
        panorama = at_rest(height, width, len(known.edges_us))
    else:
        joint = _joint(own, panorama, float(known.steps.mean()), config)
    if frames is not None:
        joint, own = _shown(frames, panorama, known.edges_us, joint)
    all_of_it, nothing = config.unexplained
    left = torch.from_numpy(unexplained(panorama, counts))
    s1, s2, dolp, log_variance = torch.lerp(own, joint, ((nothing - left) / (nothing - all_of_it)).clamp(0, 1))
    aolp = torch.remainder(torch.atan2(s2, s1) / 2, math.pi)
    return Prediction(dolp, aolp, log_variance, torch.stack([s1, s2], dim=1))


def _maps_of(dolp: Tensor, aolp: Tensor, log_variance: Tensor) -> Float[Tensor, "4 k h w"]:
    """s1, s2, DoLP and log variance."""
    return torch.stack([dolp * torch.cos(2 * aolp), dolp * torch.sin(2 * aolp), dolp, log_variance])


def _joint(own: Tensor, panorama: Panorama, step: float, config: RegistrationConfig) -> Float[Tensor, "4 k h w"]:
    """Maps of the panorama, whose constants the network's maps give."""
    height, width = own.shape[-2:]
    maps = torch.cat([torch.atanh(MAX_S * own[:2]), own[2:3].square(), own[3:]])
    means, weight = mosaic(maps.numpy(), torch.exp(-own[3]).numpy(), panorama)
    found = step * (panorama.images[:2] - panorama.images[2:]) / 2
    found += offset_field(means[:2] - found, weight, panorama, config)
    joint = config.share * found + (1 - config.share) * means[:2]
    stokes, of_network, (square, log_variance) = (
        torch.from_numpy(views(images, panorama.x[1:], panorama.y[1:], (height, width)))
        for images in (joint, means[:2], means[2:])
    )
    stokes = torch.tanh(stokes)
    spread = F.relu(square - torch.tanh(of_network).square().sum(0))
    return torch.cat([stokes, torch.sqrt(stokes.square().sum(0) + spread)[None], log_variance[None]])


def _shown(
    frames: StokesFrames, panorama: Panorama, edges_us: np.ndarray, joint: Float[Tensor, "4 k h w"]
) -> tuple[Float[Tensor, "4 k h w"], Float[Tensor, "4 k h w"]]:
    """Maps of all frames at the ends of the windows, and of the frame nearest in time; `joint` where they show nothing.

    The expected error of both is that of the mean, from the deviations of single frames from it nearby, and that of
    `joint` where no place was seen twice.
    """
    height, width = joint.shape[-2:]
    x, y = (np.interp(frames.t_us, edges_us, place) for place in (panorama.x, panorama.y))
    of_frames = panorama._replace(x=x, y=y)
    values = torch.where(frames.valid[:, None], frames.stokes, 0.0).transpose(0, 1).numpy()
    means, number = mosaic(values, frames.valid.float().numpy(), of_frames)
    expected, times = views(means, x, y, (height, width)), views(number[None], x, y, (height, width))[0]
    again = frames.valid.numpy() & (times > 1.5)
    deviations = np.square(values - expected).sum(0) / 2 * times / (times - 1).clip(min=0.5)  # of one component
    nearby = [F.avg_pool2d(torch.from_numpy(sums)[None], NEAR, 1, NEAR // 2)[0].numpy() for sums in
              _weighted(*mosaic(deviations[None], again.astype(np.float32), of_frames))]  # fmt: skip
    images = np.concatenate([*_weighted(means, number), *nearby]).astype(np.float32)
    s1, s2, total, variance, weight = torch.from_numpy(views(images, panorama.x[1:], panorama.y[1:], (height, width)))
    of_mean = variance / weight * (1 / total.clamp(min=1) + MISPLACED)
    log_variance = of_mean.clamp(min=SMALLEST_VARIANCE).log()
    log_variance = torch.where(weight > 1e-3, log_variance, joint[3])
    nearest = np.abs(frames.t_us - edges_us[1:, None]).argmin(1)
    maps = []
    for seen, stokes in (
        (total > 0.5, torch.stack([s1, s2]) / total.clamp(min=0.5)),
        (frames.valid[nearest], torch.from_numpy(values)[:, nearest]),
    ):
        found = torch.cat([stokes, stokes.square().sum(0).sqrt()[None], log_variance[None]])
        maps.append(torch.where(seen, found, joint))
    return maps[0], maps[1]


def _weighted(means: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums and weights, as images."""
    return means * weight, weight[None]


METHODS = (
    Method(
        name="registered",
        label="ours, registered",
        colour="#a61e4d",
        open=open_registered,
        networks=("polarnet",),
        shipped=True,
        takes_frames=True,
        about="The DoLP network and a panorama of the whole recording, which shows each frame what comes after it.",
        wraps=OURS,
    ),
)
