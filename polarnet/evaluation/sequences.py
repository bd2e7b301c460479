"""A simulated sequence with its truth, as methods are tested on it."""

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
    """Events of the four polarizers, and the truth at the end of each window, which methods never see."""

    __test__: ClassVar[bool] = False  # pytest takes classes of this name for its own

    name: str
    scene: str
    """The source picture that it shows."""
    events: Sequence[Events]
    """Of the four polarizers; time counts from the start of the sequence."""
    t_us: Int64[Tensor, " frames"]
    """Times of the frames, one more than there are windows: window k lies between frames k and k + 1."""
    dolp: Float[Tensor, "n h w"]
    """Truth at the end of each window, like the next two."""
    aolp: Float[Tensor, "n h w"]
    s0: Float[Tensor, "n h w"]
    valid: Bool[Tensor, "n h w"] | None = None
    """Where the truth is known, and so scored; None: everywhere."""

    @property
    def windows(self) -> list[EventWindow]:
        """The windows between its frames, each from one frame's time up to, not including, the next one's."""
        return [
            EventWindow([slice_time(events, start, stop) for events in self.events], start, stop)
            for start, stop in windows_of(self.t_us)
        ]
