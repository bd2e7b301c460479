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
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor
from torch.nn import functional as F

from polarnet.events.representations import event_counts
from polarnet.events.streaming import EventWindow
from polarnet.methods.dolp_network import METHODS as NETWORKS
from polarnet.methods.method import Method, Recoverer, Setup, State
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
    """State before a block of windows: that of the network, and what it was given in the latest ones."""

    inner: State
    counts: Float[Tensor, "k 8 h w"]
    steps: Float[Tensor, " k"]
    """Estimated change of log intensity per event in each of these windows."""
    block: "Block | None"
    """The latest run, which ended with them; None before the first."""


class Block(NamedTuple):
    """Windows that were registered together, which have maps at any of their times (`at`)."""

    own: Float[Tensor, "4 k h w"]
    """The network's s1, s2, DoLP and log variance at the ends of the windows."""
    edges_us: Int64[np.ndarray, " k1"]
    """Start of the first window and ends of all."""
    x: Float64[np.ndarray, " k1"]
    """Column and row of the panorama at the sensor's first pixel at these times."""
    y: Float64[np.ndarray, " k1"]
    joint: Float32[np.ndarray, "6 H W"] | None
    """Images of the panorama with the network's constants (`_joint`); None if the scene moves too little for one."""
    explained: Float[Tensor, "h w"]
    """Weight of the joined maps, from 0, where the panorama does not explain the events, to 1."""
    frames: StokesFrames | None
    """Frames of the camera within these windows; None if there are none."""
    shown: Float32[np.ndarray, "5 H W"] | None
    """Images of these along the motion (`_shown`)."""

    def at(self, t_us: Int64[np.ndarray, " n"]) -> Prediction:
        """Maps at times within these windows.

        With s the joined (s1, s2), DoLP^2 is |s|^2 plus the variance of the network's own (s1, s2) along the motion.
        The network's DoLP is its expectation, so its average vectors are shorter than that. With frames, s is their
        mean along the motion where they show the scene. Where the panorama does not explain the events, the network's
        maps stay, or the frame nearest in time takes their place.
        """
        x, y = (np.interp(t_us, self.edges_us, place) for place in (self.x, self.y))
        own = self._network_at(t_us, x, y)
        joint = own if self.joint is None else _polarization(self._views(self.joint, x, y))
        if self.frames is not None and self.shown is not None:
            joint, own = self._frames_at(t_us, self._views(self.shown, x, y), joint)
        s1, s2, dolp, log_variance = torch.lerp(own, joint, self.explained)
        aolp = torch.remainder(torch.atan2(s2, s1) / 2, math.pi)
        return Prediction(dolp, aolp, log_variance, torch.stack([s1, s2], dim=1))

    def _views(self, images: np.ndarray, x: np.ndarray, y: np.ndarray) -> Float[Tensor, "c n h w"]:
        height, width = self.own.shape[-2:]
        return torch.from_numpy(views(images, x, y, (height, width)))

    def _network_at(self, t_us: np.ndarray, x: np.ndarray, y: np.ndarray) -> Float[Tensor, "4 n h w"]:
        """The network's maps of the nearest ends of windows, moved along the motion."""
        ends = self.edges_us[1:]
        nearest = np.abs(ends - t_us[:, None]).argmin(1)
        maps = self.own[:, nearest]
        if (ends[nearest] == t_us).all():
            return maps
        height, width = maps.shape[-2:]
        moves = torch.eye(2, 3).repeat(len(t_us), 1, 1)
        moves[:, 0, 2] = torch.from_numpy(2 * (x - self.x[1:][nearest]) / width)
        moves[:, 1, 2] = torch.from_numpy(2 * (y - self.y[1:][nearest]) / height)
        maps = maps.transpose(0, 1)
        places = F.affine_grid(moves, list(maps.shape), align_corners=False)
        return F.grid_sample(maps, places, padding_mode="border", align_corners=False).transpose(0, 1)

    def _frames_at(
        self, t_us: np.ndarray, seen: Float[Tensor, "5 n h w"], joint: Float[Tensor, "4 n h w"]
    ) -> tuple[Float[Tensor, "4 n h w"], Float[Tensor, "4 n h w"]]:
        """Maps of all frames, from the views `seen` of their images, and of the nearest; else `joint`.

        The expected error of both is that of the mean, from the deviations of single frames from it nearby, and that
        of `joint` where no place was seen twice.
        """
        assert self.frames is not None
        s1, s2, total, variance, weight = seen
        of_mean = variance / weight * (1 / total.clamp(min=1) + MISPLACED)
        log_variance = torch.where(weight > 1e-3, of_mean.clamp(min=SMALLEST_VARIANCE).log(), joint[3])
        nearest = np.abs(self.frames.t_us - t_us[:, None]).argmin(1)
        single = torch.where(self.frames.valid[:, None], self.frames.stokes, 0.0)[nearest].transpose(0, 1)
        maps = []
        for known, stokes in (
            (total > 0.5, torch.stack([s1, s2]) / total.clamp(min=0.5)),
            (self.frames.valid[nearest], single),
        ):
            found = torch.cat([stokes, stokes.square().sum(0).sqrt()[None], log_variance[None]])
            maps.append(torch.where(known, found, joint))
        return maps[0], maps[1]


def open_registered(setup: Setup) -> Recoverer:
    """Open the network from the checkpoint in the setup, for whole recordings."""
    inner, config = OURS.open(setup), setup.registration
    network: Any = inner.network
    scales: list[Tensor] = []
    network.scale.register_forward_hook(lambda module, features, scale: scales.append(scale.flatten().cpu()))

    def start(height: int, width: int) -> Past:
        return Past(inner.start(height, width), torch.zeros(0, 8, height, width), torch.zeros(0), None)

    def predict(past: Past, windows: Sequence[EventWindow]) -> tuple[Past, Prediction]:
        scales.clear()
        state, prediction = inner.run(past.inner, windows, inner.at_once(*past.counts.shape[-2:]))
        own, edges_us = _maps_of(*prediction[:3]), np.array([windows[0].start_us])  # type: ignore[arg-type]
        if past.block is not None:
            first = past.block.own.shape[1] - len(past.counts)
            own, edges_us = torch.cat([past.block.own[:, first:], own], dim=1), past.block.edges_us[first:]
        edges_us = np.append(edges_us, [window.stop_us for window in windows])
        new = [torch.cat([event_counts(one, window.length_us) for one in window.channels]) for window in windows]
        counts = torch.cat([past.counts, torch.stack(new).cpu()])
        steps = torch.cat([past.steps, network.step * torch.cat(scales).float().mean().expand(len(windows))])
        block = registered(counts, own, edges_us, float(steps.mean()), config, setup.frames)
        if block.joint is not None or block.frames is not None:
            prediction = block.at(edges_us[-len(windows) :])
        latest = slice(max(0, len(counts) - config.overlap), None)
        return Past(state, counts[latest], steps[latest], block), prediction

    def between(past: Past, t_us: Int64[np.ndarray, " n"]) -> Prediction:
        assert past.block is not None
        return past.block.at(t_us)

    return Recoverer(start, predict, network=network, at_once=lambda height, width: config.windows, between=between)


def registered(
    counts: Float[Tensor, "k 8 h w"],
    own: Float[Tensor, "4 k h w"],
    edges_us: Int64[np.ndarray, " k1"],
    step: float,
    config: RegistrationConfig,
    frames: StokesFrames | None,
) -> Block:
    """Register windows and join the network's maps with their panorama, and with the frames in this time."""
    polarity, number = counts.unflatten(1, (4, 2)).permute(2, 1, 0, 3, 4).numpy()
    events = np.stack([number + polarity, number - polarity], axis=1) / 2
    panorama = register(events, config) if len(counts) >= FEWEST else None
    frames = frames and frames.between(int(edges_us[0]), int(edges_us[-1]))
    frames = frames if frames and len(frames.t_us) else None
    joint = None if panorama is None else _joint(own, panorama, step, config)
    height, width = own.shape[-2:]
    panorama = panorama or at_rest(height, width, len(edges_us))
    shown = None if frames is None else _shown(frames, panorama, edges_us)
    all_of_it, nothing = config.unexplained
    left = torch.from_numpy(unexplained(panorama, events))
    explained = ((nothing - left) / (nothing - all_of_it)).clamp(0, 1)
    return Block(own, edges_us, panorama.x, panorama.y, joint, explained, frames, shown)


def _maps_of(dolp: Tensor, aolp: Tensor, log_variance: Tensor) -> Float[Tensor, "4 k h w"]:
    """s1, s2, DoLP and log variance."""
    return torch.stack([dolp * torch.cos(2 * aolp), dolp * torch.sin(2 * aolp), dolp, log_variance])


def _joint(own: Tensor, panorama: Panorama, step: float, config: RegistrationConfig) -> Float32[np.ndarray, "6 H W"]:
    """Images of atanh(s1) and atanh(s2), of those of the network alone, and of its DoLP^2 and log variance.

    The first two are those of the panorama, whose constants the network's maps give.
    """
    maps = torch.cat([torch.atanh(MAX_S * own[:2]), own[2:3].square(), own[3:]])
    means, weight = mosaic(maps.numpy(), torch.exp(-own[3]).numpy(), panorama)
    found = step * (panorama.images[:2] - panorama.images[2:]) / 2
    found += offset_field(means[:2] - found, weight, panorama, config)
    return np.concatenate([config.share * found + (1 - config.share) * means[:2], means])


def _polarization(joint: Float[Tensor, "6 n h w"]) -> Float[Tensor, "4 n h w"]:
    """s1, s2, DoLP and log variance of views of the images of `_joint`."""
    stokes, of_network = torch.tanh(joint[:2]), torch.tanh(joint[2:4])
    spread = F.relu(joint[4] - of_network.square().sum(0))
    return torch.cat([stokes, torch.sqrt(stokes.square().sum(0) + spread)[None], joint[5:]])


def _shown(frames: StokesFrames, panorama: Panorama, edges_us: np.ndarray) -> Float32[np.ndarray, "5 H W"]:
    """Sums of s1, s2, of frames, of the variance of single frames, and of its weights, along the motion."""
    x, y = (np.interp(frames.t_us, edges_us, place) for place in (panorama.x, panorama.y))
    height, width = frames.valid.shape[-2:]
    of_frames, size = panorama._replace(x=x, y=y), (height, width)
    values = torch.where(frames.valid[:, None], frames.stokes, 0.0).transpose(0, 1).numpy()
    means, number = mosaic(values, frames.valid.float().numpy(), of_frames)
    expected, times = views(means, x, y, size), views(number[None], x, y, size)[0]
    again = frames.valid.numpy() & (times > 1.5)
    deviations = np.square(values - expected).sum(0) / 2 * times / (times - 1).clip(min=0.5)  # of one component
    nearby = [F.avg_pool2d(torch.from_numpy(sums)[None], NEAR, 1, NEAR // 2)[0].numpy() for sums in
              _weighted(*mosaic(deviations[None], again.astype(np.float32), of_frames))]  # fmt: skip
    return np.concatenate([*_weighted(means, number), *nearby]).astype(np.float32)


def _weighted(means: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums and weights, as images."""
    return means * weight, weight[None]


METHODS = (
    Method(
        name="registered",
        label="ours, registered",
        colour="#be4bdb",
        open=open_registered,
        networks=("polarnet",),
        shipped=True,
        takes_frames=True,
        about="The DoLP network and a panorama of the whole recording, which shows each frame what comes after it.",
        wraps=OURS,
    ),
)
