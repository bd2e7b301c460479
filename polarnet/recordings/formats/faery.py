"""Formats read by the package faery: AEDAT4 of iniVation, and Event Stream.

Its EVT3 decoder holds times back where the sensor's clock steps back, so `prophesee` reads EVT2 and EVT3.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polarnet.recordings.formats.isolated import IsolatedLibrary
from polarnet.recordings.source import Block, CameraFrames, Choices, RecordingError, Source, sensor_size

AEDAT4 = b"#!AER-DAT4"
EVENT_STREAM = b"Event Stream"

_library = IsolatedLibrary(
    "faery", "faery", "recordings", Path(__file__).with_name("faery_tasks.py"), "the file is damaged"
)


def matches_aedat4(path: Path, head: bytes) -> bool:
    """Whether the file starts with the signature of AEDAT4."""
    return head.startswith(AEDAT4)


def matches_event_stream(path: Path, head: bytes) -> bool:
    """Whether the file starts with the signature of Event Stream."""
    return head.startswith(EVENT_STREAM)


def open_aedat4(path: Path, choices: Choices) -> Source:
    """Open the first event stream of the file; its times are microseconds since 1970."""
    return _source(path, choices, "aedat")


def open_event_stream(path: Path, choices: Choices) -> Source:
    """Open the change events of a DVS or ATIS."""
    return _source(path, choices, "es")


def aedat4_frames(path: Path) -> CameraFrames:
    """Grey frames, timed by the middle of their exposure, or by their time stamp where the file has no exposure."""
    answer = _library.ask(path, "frames")
    if answer is None:
        raise RecordingError(
            f"{path.name}: expected raw frames of one size and one channel as true polarization, there are none"
        )
    return CameraFrames(*answer)


def _source(path: Path, choices: Choices, file_type: str) -> Source:
    height, width = sensor_size(path, choices, *_library.ask(path, "size", file_type))

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        for table in _library.blocks(path, file_type):
            t, x, y, on = (np.ascontiguousarray(table[name]) for name in ("t", "x", "y", "on"))
            yield Block(t, x, y, on.view(np.uint8))

    return Source(height, width, blocks)
