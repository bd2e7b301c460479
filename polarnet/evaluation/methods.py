"""Every way to recover DoLP behind one signature: a recording in, a DoLP (and AoLP) frame per window out.

A method that gives intensities becomes DoLP here and nowhere else, and DoLP is clamped to [0, 1] here and nowhere else,
for every method alike. Another method is one function and one entry in `METHODS`.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from polarnet.baselines.complementary_filter import (
    ComplementaryFilterConfig,
    HighPassConfig,
    reconstruct_cf,
    reconstruct_highpass,
)
from polarnet.baselines.firenet import FireNet
from polarnet.baselines.trivial import constant, oracle_mean
from polarnet.events.representations import REPRESENTATIONS, normalise_nonzero, voxel_grid
from polarnet.events.stream import Events
from polarnet.events.windows import encode_windows
from polarnet.networks.checkpoint import load_checkpoint, load_network, load_tensors
from polarnet.stokes import aolp, dolp, stokes_from_intensities


@dataclass(frozen=True)
class Recording:
    """One sequence as the methods see it, and its truth, which of all methods only `oracle_mean` looks at."""

    name: str
    scene: str
    """The source picture that it shows."""
    events: Sequence[Events]
    """Of the four polarizers; time counts from the start of the sequence."""
    t_us: Int64[Tensor, " frames"]
    """Times of the frames, one more than there are windows: window k lies between frames k and k + 1."""
    dolp: Float[Tensor, "n h w"]
    """Truth at the end of each window; so are the next two."""
    aolp: Float[Tensor, "n h w"]
    s0: Float[Tensor, "n h w"]
    valid: Bool[Tensor, "n h w"] | None = None
    """Where the truth is known, and so scored; None: everywhere."""


class Polarization(NamedTuple):
    """What a method makes of a recording, not yet clamped; AoLP in radians, None where the method has none."""

    dolp: Float[Tensor, "n h w"]
    aolp: Float[Tensor, "n h w"] | None = None


class Recovered(NamedTuple):
    """A method's answer, DoLP in [0, 1] (float32), and what it took."""

    dolp: Float[Tensor, "n h w"]
    aolp: Float[Tensor, "n h w"] | None
    seconds: float


@dataclass(frozen=True)
class Context:
    """What methods need beside the recording. Networks are loaded when a method first asks for them."""

    train_mean: float
    """Mean DoLP of the training split."""
    cf: ComplementaryFilterConfig
    highpass: HighPassConfig
    e2v_checkpoint: Path
    ours_checkpoint: Path
    device: torch.device
    precision: str
    """Of the networks: fp32, or bf16 autocast."""

    @cached_property
    def e2v(self) -> FireNet:
        """The network that turns events into intensity."""
        tensors, metadata = load_checkpoint(self.e2v_checkpoint)
        network = FireNet(**metadata["config"])
        load_tensors(network, tensors, self.e2v_checkpoint)
        return network.eval().to(self.device)

    @cached_property
    def ours(self) -> tuple[nn.Module, dict[str, Any]]:
        """The network that turns events into DoLP, and its checkpoint's metadata."""
        network, metadata = load_network(self.ours_checkpoint)
        return network.to(self.device), metadata

    def autocast(self) -> torch.autocast:
        """The precision of the networks, for a `with`."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bf16")


Method = Callable[[Recording, Context], Polarization]
IntensityMethod = Callable[[Recording, Context], Float[Tensor, "n 4 h w"]]


@torch.no_grad()
def recover(method: str, recording: Recording, context: Context) -> Recovered:
    """Run one of `METHODS`, clamp its DoLP, and take the time: from events in memory to frames in memory."""
    start = time.perf_counter()
    found = METHODS[method](recording, context)
    recovered = found.dolp.float().clamp(0, 1).cpu()
    seconds = time.perf_counter() - start
    return Recovered(recovered, None if found.aolp is None else found.aolp.float().cpu(), seconds)


def zeros(recording: Recording, context: Context) -> Polarization:
    """No polarization anywhere."""
    return Polarization(constant(0.0, recording.dolp))


def train_mean(recording: Recording, context: Context) -> Polarization:
    """What the training split has on average, everywhere."""
    return Polarization(constant(context.train_mean, recording.dolp))


def own_mean(recording: Recording, context: Context) -> Polarization:
    """The best of all constants for each frame, which only the truth can tell."""
    return Polarization(oracle_mean(recording.dolp, recording.valid))


def from_intensities(method: IntensityMethod) -> Method:
    """Turn intensities behind the four polarizers, on a scale common to the four, into DoLP and AoLP (Eq. 1-3)."""

    def polarization(recording: Recording, context: Context) -> Polarization:
        stokes = stokes_from_intensities(method(recording, context))
        return Polarization(dolp(stokes), aolp(stokes))

    return polarization


def cf_intensities(recording: Recording, context: Context) -> Float[Tensor, "n 4 h w"]:
    """The complementary filter, events only, once for each polarizer."""
    return torch.stack([reconstruct_cf(e, recording.t_us[1:], context.cf) for e in recording.events], dim=1)


def highpass_intensities(recording: Recording, context: Context) -> Float[Tensor, "n 4 h w"]:
    """The high-pass filter, once for each polarizer."""
    return torch.stack([reconstruct_highpass(e, recording.t_us[1:], context.highpass) for e in recording.events], dim=1)


def e2v_intensities(recording: Recording, context: Context) -> Float[Tensor, "n 4 h w"]:
    """The trained events-to-video network; the polarizers are four streams of one batch. Clipped to [0, 1]."""
    network, state, frames = context.e2v, None, []
    grids = encode_windows(recording.events, recording.t_us, lambda events, window_us: voxel_grid(events, network.bins))
    for window in grids.unflatten(1, (4, network.bins)):
        with context.autocast():
            intensity, state = network(normalise_nonzero(window.to(context.device)), state)
        frames.append(intensity.float().clamp(0, 1))
    return torch.stack(frames)


def ours(recording: Recording, context: Context) -> Polarization:
    """The DoLP network, window by window with its state carried on, as it would run behind a camera."""
    network, metadata = context.ours
    inputs = encode_windows(recording.events, recording.t_us, REPRESENTATIONS[metadata["representation"]])
    state, frames = None, []
    for window in inputs:
        with context.autocast():
            prediction, state = network(window[None].to(context.device), state)
        frames.append(prediction)
    has_aolp = frames[0].aolp is not None
    return Polarization(
        torch.cat([frame.dolp for frame in frames]),
        torch.cat([frame.aolp for frame in frames]) if has_aolp else None,
    )


METHODS: dict[str, Method] = {
    "zeros": zeros,
    "train_mean": train_mean,
    "oracle_mean": own_mean,
    "cf": from_intensities(cf_intensities),
    "highpass": from_intensities(highpass_intensities),
    "e2v": from_intensities(e2v_intensities),
    "ours": ours,
}
