"""Stored sequences with their ground truth, cut into encoded windows, as a torch `Dataset`."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int8
from torch import Tensor
from torch.utils.data import Dataset

from polarnet.events.representations import Encode
from polarnet.events.stream import Events
from polarnet.events.streaming import encode_windows
from polarnet.storage.frames import FrameStore


@runtime_checkable
class EventSource(Protocol):
    """A source of named sequences' events, read by time window: a store on disk, or an emulator.

    `polarnet.storage.events.EventStore` reads stored events; `polarnet.simulation.dataset.EmulatedEvents` makes them on
    request.
    """

    path: str
    """Path of the event store, or of the scenes that the events are made from."""
    sequences: list[str]
    height: int
    """Rows of the sensor."""
    width: int
    """Columns of the sensor."""
    attributes: dict[str, Any]
    """All settings that the events depend on, besides the data at `path`."""

    def read(self, sequence: str, start_us: int | None = None, stop_us: int | None = None) -> list[Events]:
        """The four channels of a sequence, or their events with start <= t < stop."""


class WindowSequence(NamedTuple):
    """All windows of a sequence, with the truth at the end of each."""

    name: str
    inputs: Float[Tensor, "t c h w"] | Int8[Tensor, "t c h w"]
    """Channel by channel (0, 45, 90, 135 degrees); c is 4 times the images per channel of the representation.

    int8 only in the memory of a training, where that is exact.
    """
    dolp: Float[Tensor, "t h w"]
    aolp: Float[Tensor, "t h w"]
    intensity: Float[Tensor, "t 4 h w"]
    """Empty (t = 0) in the memory of a training that does not need intensities."""
    valid: Bool[Tensor, "t h w"] | None = None
    """Where the truth is known; None: everywhere."""


class WindowDataset(Dataset[WindowSequence]):
    """Item i holds all windows of sequence i, encoded on access. Frames give the windows' ends and the truth."""

    def __init__(self, events: EventSource, frames: FrameStore, sequences: list[str], encode: Encode):
        absent = [name for name in sequences if name not in set(events.sequences) & set(frames.sequences)]
        if absent:
            raise ValueError(f"{', '.join(absent[:8])}: not both in {events.path} and in {frames.path}")
        if (events.height, events.width) != (frames.height, frames.width):
            raise ValueError(
                f"events are {events.height}x{events.width} px ({events.path}), "
                f"frames {frames.height}x{frames.width} ({frames.path}); write both from the same scenes"
            )
        self.events = events
        self.frames = frames
        self.sequences = sequences
        self.encode = encode

    def __len__(self) -> int:
        return len(self.sequences)

    def __getitem__(self, i: int) -> WindowSequence:
        name = self.sequences[i]
        t_us, intensity, dolp, aolp, valid = self.frames.frames(name)
        inputs = encode_windows(self.events.read(name), t_us, self.encode)
        known = None if valid is None else valid[1:]
        return WindowSequence(name, inputs, dolp[1:], aolp[1:], intensity[1:], known)
