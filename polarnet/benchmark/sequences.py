"""Simulated sequences with their truth, for testing methods."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Bool, Float, Int64
from torch import Tensor

from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import EventWindow
from polarnet.events.windows import windows_of


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

    @property
    def windows(self) -> list[EventWindow]:
        """Windows between consecutive frames, half-open: each includes its start and excludes its end."""
        return self._windows(self.events)

    def windows_for(self, rotating: bool) -> list[EventWindow]:
        """The same windows of the four channels, or of the camera behind a rotating polarizer.

        ValueError if the latter was not simulated.
        """
        if not rotating:
            return self.windows
        if self.rotating is None:
            raise ValueError(
                f"{self.name}: there are no events of a camera behind a rotating polarizer; {NOT_ROTATING}"
            )
        empty = Events.empty(self.rotating.height, self.rotating.width)
        return self._windows([self.rotating, *[empty] * (len(self.events) - 1)])

    def _windows(self, channels: Sequence[Events]) -> list[EventWindow]:
        return [
            EventWindow([slice_time(events, start, stop) for events in channels], start, stop)
            for start, stop in windows_of(self.t_us)
        ]
