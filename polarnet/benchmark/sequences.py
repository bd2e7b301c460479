"""Test sequences with their truth, for testing methods."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Bool, Float, Int64
from torch import Tensor

from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import EventWindow, windows_of
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore


@dataclass(frozen=True)
class TestSequence:
    """Events of the four channels, and the truth at the end of each window, which methods never see."""

    __test__: ClassVar[bool] = False  # pytest would collect a class of this name

    name: str
    scene: str
    """Name of the source picture."""
    events: Sequence[Events]
    """Events of the four channels; time starts with the sequence."""
    t_us: Int64[Tensor, " frames"]
    """Times of the n + 1 frames; window k lies between frames k and k + 1."""
    dolp: Float[Tensor, "n h w"]
    """True DoLP at the end of each window; `aolp` and `s0` likewise."""
    aolp: Float[Tensor, "n h w"]
    s0: Float[Tensor, "n h w"]
    valid: Bool[Tensor, "n h w"] | None = None
    """Pixels with known truth, which are scored; None: all pixels."""
    rotating: Events | None = None
    """Events of one camera behind a rotating polarizer that moves like the four channels; None: not simulated."""

    def windows(self, rotating: bool = False) -> list[EventWindow]:
        """Windows of the four channels, or of the camera behind a rotating polarizer, in the first channel.

        They lie between consecutive frames and are half-open: each includes its start and excludes its end. ValueError
        if that camera was not simulated.
        """
        channels = list(self.events)
        if rotating:
            if self.rotating is None:
                raise ValueError(
                    f"{self.name}: expected events of a camera behind a rotating polarizer, there are none; leave the "
                    f"row rotating_polarizer out of the methods"
                )
            channels = [self.rotating, *[slice_time(self.rotating, 0, 0)] * (len(channels) - 1)]
        return [
            EventWindow([slice_time(events, start, stop) for events in channels], start, stop)
            for start, stop in windows_of(self.t_us)
        ]


@dataclass(frozen=True)
class BenchmarkSet:
    """Stores of test sequences with their truth."""

    name: str
    events: EventStore
    frames: FrameStore
    rotating: EventStore | None = None
    """Events of one camera behind a rotating polarizer, in the first channel; None: no row needs them."""

    @property
    def sequences(self) -> list[str]:
        """Sequences of the test split, in the store's order; ValueError if there are none."""
        names = self.frames.of_split("test")
        if not names:
            raise ValueError(
                f"{self.frames.path} has no test sequence; raise ingest.test_fraction or ingest more pictures"
            )
        return names

    def sequence(self, name: str) -> TestSequence:
        """One sequence with its truth."""
        truth = self.frames.frames(name)
        valid = None if truth.valid is None else truth.valid[1:]
        rotating = None if self.rotating is None else self.rotating.read(name)[0]
        scene, events, s0 = self.frames.original_of(name), self.events.read(name), truth.intensity[1:, ::2].sum(1)
        return TestSequence(name, scene, events, truth.t_us, truth.dolp[1:], truth.aolp[1:], s0, valid, rotating)


def train_mean_dolp(frames: FrameStore, warmup_windows: int) -> float:
    """Mean DoLP of the training split, over the windows and pixels that the benchmark scores.

    ValueError if the split is empty.
    """
    total, count = 0.0, 0
    for name in frames.of_split("train"):
        scored = frames.quantity("dolp", name)[1 + warmup_windows :]
        if frames.masked:
            scored = scored[frames.quantity("valid", name)[1 + warmup_windows :]]
        total, count = total + scored.double().sum().item(), count + scored.numel()
    if count == 0:
        raise ValueError("the mean DoLP needs at least one frame, got none: is the training split empty?")
    return total / count
