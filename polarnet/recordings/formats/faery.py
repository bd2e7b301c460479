"""Formats that the package faery reads: AEDAT4 of iniVation, and Event Stream.

Its decoder of EVT3 holds times back where the sensor's clock steps back, so EVT2 and EVT3 are read in `evt`.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from polarnet.recordings.source import Block, Choices, RecordingError, Source, sensor_size

AEDAT4 = b"#!AER-DAT4"
EVENT_STREAM = b"Event Stream"
GATHERED_EVENTS = 2**16


def matches_aedat4(path: Path, head: bytes) -> bool:
    """By its first bytes."""
    return head.startswith(AEDAT4)


def matches_event_stream(path: Path, head: bytes) -> bool:
    """By its first bytes."""
    return head.startswith(EVENT_STREAM)


def open_aedat4(path: Path, choices: Choices) -> Source:
    """The first stream of events of the file; its times are microseconds since 1970."""
    return _source(path, choices, "aedat")


def open_event_stream(path: Path, choices: Choices) -> Source:
    """The changes of a DVS or ATIS."""
    return _source(path, choices, "es")


def _source(path: Path, choices: Choices, file_type: str) -> Source:
    width, height = _guarded(path, lambda: _decoder(path, file_type).dimensions())
    height, width = sensor_size(path, choices, height, width)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        packets = iter(_guarded(path, lambda: _decoder(path, file_type)))
        waiting, count = [], 0  # packets are small
        while (packet := _guarded(path, lambda: next(packets, None))) is not None:
            waiting.append(packet)
            count += len(packet)
            if count >= GATHERED_EVENTS:
                yield _block(waiting)
                waiting, count = [], 0
        if count:
            yield _block(waiting)

    return Source(height, width, blocks)


def _block(packets: list[np.ndarray]) -> Block:
    joined = np.concatenate(packets)
    return Block(joined["t"], joined["x"], joined["y"], joined["on"].view(np.uint8))


def _decoder(path: Path, file_type: str) -> Any:
    try:
        import faery
    except ImportError:
        raise RuntimeError(f"{path.name}: this format needs faery: pip install 'polarnet[recordings]'") from None
    return faery.events_stream_from_file(path, file_type=file_type)


def _guarded(path: Path, call: Any) -> Any:
    """What faery answers; whatever it raises about a damaged file becomes a RecordingError."""
    try:
        return call()
    except (RuntimeError, RecordingError) as error:
        if isinstance(error.__context__, ImportError):
            raise
        raise RecordingError(f"{path.name}: faery cannot read it: {error}") from error
    except BaseException as error:  # a panic of its Rust code is no Exception
        if isinstance(error, (KeyboardInterrupt, SystemExit, GeneratorExit)):
            raise
        raise RecordingError(f"{path.name}: faery cannot read it: {error}") from error
