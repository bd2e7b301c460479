"""The DoLP network over a whole recording: its maps and one panorama of all events, joined.

The network sees the past alone and forgets. `register` compares all windows of a recording with each other, which gives
the pattern of atanh(s1) and atanh(s2), but no constants. The network's maps, averaged along the motion, give these.
A panorama shows a scene that moves as one plane; so does a camera that turns.

Blocks of `windows` windows are registered together with `overlap` earlier ones, so a recording may have any length.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from polarnet.events.representations import event_counts
from polarnet.events.streaming import EventWindow
from polarnet.methods.dolp_network import METHODS as NETWORKS
from polarnet.methods.method import Method, Recoverer, Setup, State, each_map, joined
from polarnet.methods.registration import RegistrationConfig, mosaic, offset_field, register, unexplained, views
from polarnet.stokes import Prediction

FEWEST = 8  # windows in which a panorama can be found
MAX_S = 0.98  # limit of s1 and s2, so that atanh is finite

OURS = next(method for method in NETWORKS if method.name == "ours")


class Past(NamedTuple):
    """State before a block of windows: that of the network, and what it was given and predicted in the latest ones."""

    inner: State
    counts: Float[Tensor, "k 8 h w"]
    predicted: Prediction | None
    """Maps of the same k windows; None before the first."""
    steps: Float[Tensor, " k"]
    """Estimated change of log intensity per event in each of them."""


def open_registered(setup: Setup) -> Recoverer:
    """Open the network from the checkpoint in the setup, for whole recordings."""
    inner, config = OURS.open(setup), setup.registration
    network: Any = inner.network
    scales: list[Tensor] = []
    network.scale.register_forward_hook(lambda module, features, scale: scales.append(scale.flatten().cpu()))

    def start(height: int, width: int) -> Past:
        return Past(inner.start(height, width), torch.zeros(0, 8, height, width), None, torch.zeros(0))

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
        known = Past(state, torch.cat([past.counts, counts]), together, torch.cat([past.steps, steps]))
        new = registered(known, config) if len(windows) > 1 else None
        latest = slice(max(0, len(known.counts) - config.overlap), None)
        kept = Past(state, known.counts[latest], each_map(together, lambda maps: maps[latest]), known.steps[latest])
        return kept, own if new is None else each_map(new, lambda maps: maps[-len(windows) :].to(own.dolp.device))

    return Recoverer(start, predict, network=network, at_once=lambda height, width: config.windows, sees_ahead=True)


def registered(known: Past, config: RegistrationConfig) -> Prediction | None:
    """Join the network's maps with the panorama of the same windows; None if the scene moves too little for one.

    With s the joined (s1, s2), DoLP^2 is |s|^2 plus the variance of the network's own (s1, s2) along the motion. The
    network's DoLP is its expectation, so its average vectors are shorter than that. Where the panorama does not explain
    the events, the network's maps stay.
    """
    if len(known.counts) < FEWEST:
        return None
    polarity, number = known.counts.unflatten(1, (4, 2)).permute(2, 1, 0, 3, 4).numpy()
    counts = np.stack([number + polarity, number - polarity], axis=1) / 2
    panorama = register(counts, config)
    if panorama is None:
        return None
    assert known.predicted is not None
    dolp, aolp, log_variance = (field.cpu().float() for field in known.predicted[:3] if field is not None)
    own = dolp * torch.stack([torch.cos(2 * aolp), torch.sin(2 * aolp)])
    maps = torch.cat([torch.atanh(MAX_S * own), dolp.square()[None], log_variance[None]])
    means, weight = mosaic(maps.numpy(), torch.exp(-log_variance).numpy(), panorama)
    found = float(known.steps.mean()) * (panorama.images[:2] - panorama.images[2:]) / 2
    found += offset_field(means[:2] - found, weight, panorama, config)
    joint = config.share * found + (1 - config.share) * means[:2]
    stokes, of_network, (square, expected) = (
        torch.from_numpy(views(images, panorama.x[1:], panorama.y[1:], number.shape[-2:]))
        for images in (joint, means[:2], means[2:])
    )
    stokes = torch.tanh(stokes)
    spread = F.relu(square - torch.tanh(of_network).square().sum(0))
    joint_dolp = torch.sqrt(stokes.square().sum(0) + spread)
    all_of_it, nothing = config.unexplained
    left = torch.from_numpy(unexplained(panorama, counts))
    share = ((nothing - left) / (nothing - all_of_it)).clamp(0, 1)
    s1, s2 = torch.lerp(own, stokes, share)
    aolp = torch.remainder(torch.atan2(s2, s1) / 2, math.pi)
    dolp, log_variance = torch.lerp(dolp, joint_dolp, share), torch.lerp(log_variance, expected, share)
    return Prediction(dolp, aolp, log_variance, torch.stack([s1, s2], dim=1))


METHODS = (
    Method(
        name="registered",
        label="ours, registered",
        colour="#a61e4d",
        open=open_registered,
        networks=("polarnet",),
        shipped=True,
        about="The DoLP network and a panorama of the whole recording, which shows each frame what comes after it.",
        wraps=OURS,
    ),
)
