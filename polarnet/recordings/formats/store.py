"""Read one channel of one sequence from polarnet's own event store."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from polarnet.recordings.source import BLOCK_EVENTS, Block, Choices, RecordingError, Source, sensor_size
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.events import EventStore

ZIP = b"PK\x03\x04"


def matches(path: Path, head: bytes) -> bool:
    """Whether it is a folder with Zarr metadata, or a zip."""
    return (path / "zarr.json").exists() if path.is_dir() else head.startswith(ZIP)


def open_store(path: Path, choices: Choices) -> Source:
    """Open the channel that `part` names as SEQUENCE/ANGLE (degrees); SEQUENCE is optional if there is only one."""
    try:
        store = EventStore.open(path)
    except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path.name}: {error}") from error
    sequence, _, angle = (choices.part or "").rpartition("/")
    if not sequence and len(store.sequences) == 1:
        sequence = store.sequences[0]
    angles = [str(a) for a in POLARIZER_ANGLES_DEG]
    if sequence not in store.sequences or angle not in angles:
        names = ", ".join(store.sequences[:8]) + (", ..." if len(store.sequences) > 8 else "")
        raise RecordingError(
            f"{path.name}: say which part to read as SEQUENCE/ANGLE, with a sequence of {names} and an angle of "
            f"{', '.join(angles)}; got {choices.part!r}"
        )
    channel = angles.index(angle)
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
