"""Read one channel of one sequence from polarnet's own event store."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from polarnet.recordings.source import BLOCK_EVENTS, Block, Choices, RecordingError, Source, chosen_part, sensor_size
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

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        try:
            duration_us = store.duration_us(sequence)
            parts = -(-sum(store.count(sequence)) // BLOCK_EVENTS)
            edges = [duration_us * k // max(1, parts) for k in range(max(1, parts))]
            for start, stop in zip(edges, [*edges[1:], duration_us + 1], strict=True):
                events = store.read(sequence, start, stop)[channel]
                yield Block(events.t.numpy(), events.x.numpy(), events.y.numpy(), events.p.numpy())
        except ValueError as error:
            raise RecordingError(str(error)) from error

    return Source(height, width, blocks)
