"""Read one channel of one sequence from polarnet's own event store."""

from collections.abc import Iterator
from pathlib import Path

from polarnet.events.stream import Events
from polarnet.recordings.source import (
    BLOCK_EVENTS,
    Block,
    Choices,
    Counts,
    RecordingError,
    Source,
    chosen_part,
    sensor_size,
)
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.events import EventStore

ANGLES = [str(angle) for angle in POLARIZER_ANGLES_DEG]


def matches(path: Path, head: bytes) -> bool:
    """Whether it is a folder with Zarr metadata."""
    return (path / "zarr.json").exists()


def open_store(path: Path, choices: Choices) -> Source:
    """Open the channel that `part` names as SEQUENCE/ANGLE (degrees); SEQUENCE is optional if there is only one."""
    try:
        store = EventStore.open(path)
    except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path.name}: {error}") from error
    part = choices.part
    if part in ANGLES and len(store.sequences) == 1:
        part = f"{store.sequences[0]}/{part}"
    parts = [f"{sequence}/{angle}" for sequence in store.sequences for angle in ANGLES]
    sequence, _, angle = chosen_part(path, part, parts, "channel").rpartition("/")
    channel = ANGLES.index(angle)
    height, width = sensor_size(path, choices, store.height, store.width)

    def blocks(counts: Counts) -> Iterator[Block]:
        try:
            total = max(1, store.count(sequence)[channel])
            for number, events in enumerate(channel_chunks(store, sequence, channel)):
                counts.share_read = min(1.0, number * BLOCK_EVENTS / total)
                yield Block(*(getattr(events, name).numpy() for name in "txyp"))
        except ValueError as error:
            raise RecordingError(str(error)) from error

    return Source(height, width, blocks)


def channel_chunks(store: EventStore, sequence: str, channel: int) -> Iterator[Events]:
    """The events of one channel of a sequence, in chunks."""
    first, end = store.record(sequence)["offsets"][channel : channel + 2]
    for start in range(first, end, BLOCK_EVENTS):
        yield from store.rows(sequence, [(start, min(start + BLOCK_EVENTS, end))])
