"""Formats read by the package faery: AEDAT4 of iniVation, and Event Stream.

Its EVT3 decoder holds times back where the sensor's clock steps back, so `prophesee` reads EVT2 and EVT3.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

from polarnet.recordings.formats import isolated_worker
from polarnet.recordings.formats.isolated import Library, ask, ask_once
from polarnet.recordings.source import Block, CameraFrames, Choices, RecordingError, Source, sensor_size

FAERY = Library("faery", "faery", "recordings", "the file is damaged")


def opener(file_type: str) -> Callable[[Path, Choices], Source]:
    """A function that opens AEDAT4's first event stream (`aedat`, microseconds since 1970), or Event Stream (`es`)."""

    def open_file(path: Path, choices: Choices) -> Source:
        def blocks(counts: Counter[str]) -> Iterator[Block]:
            for columns in ask(FAERY, path, isolated_worker.faery_events, file_type):
                yield Block(*columns)

        size = ask_once(FAERY, path, isolated_worker.faery_size, file_type)
        return Source(*sensor_size(path, choices, *size), blocks)

    return open_file


def aedat4_frames(path: Path) -> CameraFrames:
    """Grey frames, timed by the middle of their exposure, or by their time stamp where the file has no exposure."""
    frames = ask_once(FAERY, path, isolated_worker.aedat4_frames)
    if frames is None:
        raise RecordingError(
            f"{path.name}: expected raw frames of one size and one channel as true polarization, there are none"
        )
    return CameraFrames(*frames)
