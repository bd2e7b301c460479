"""Formats read by the package faery: AEDAT4 of iniVation, and Event Stream.

Its EVT3 decoder holds times back where the sensor's clock steps back, so `prophesee` reads EVT2 and EVT3.
"""

from collections.abc import Iterator
from pathlib import Path

from polarnet.recordings.formats import isolated_worker
from polarnet.recordings.formats.isolated import Library, ask, ask_once
from polarnet.recordings.source import Block, CameraFrames, Choices, Counts, RecordingError, Source

FAERY = Library("faery", "faery", "the file is damaged")


def open_faery(path: Path, choices: Choices, *, aedat4: bool) -> Source:
    """Open Event Stream, or of AEDAT4 the only stream of events or that of the number `part`, with times since 1970.

    A file of AEDAT4 that ends within a packet is read up to there.
    """
    streams = ask_once(FAERY, path, isolated_worker.faery_streams, aedat4)
    stream = choices.part_of(path.name, list(streams), "stream of events")

    def blocks(counts: Counts) -> Iterator[Block]:
        for columns in ask(FAERY, path, isolated_worker.faery_events, stream):
            if columns is None:
                counts["cut_tail"] += 1
            else:
                yield Block(*columns)

    height, width = streams[stream]
    return Source(height, width, blocks)


def aedat4_frames(path: Path) -> CameraFrames:
    """Grey frames, timed by the middle of their exposure, or by their time stamp where the file has no exposure."""
    frames = ask_once(FAERY, path, isolated_worker.aedat4_frames)
    if frames is None:
        raise RecordingError(
            f"{path.name}: expected raw frames of one size and one channel as true polarization, there are none"
        )
    return CameraFrames(*frames)
