"""Read event-camera files: whole with `read_recording`, in chunks of constant memory with `open_recording`."""

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from polarnet.events.stream import Events
from polarnet.recordings.content import GZIP, ZIP, start_of
from polarnet.recordings.formats import aedat, celex5, faery, hdf5, lines, prophesee, rosbag
from polarnet.recordings.repair import HARMLESS, repaired
from polarnet.recordings.source import REPAIRS, Blocks, CameraFrames, Choices, Counts, RecordingError, Source, cut

CHUNK_EVENTS = 2**20

logger = logging.getLogger(__name__)


class Format(NamedTuple):
    """How to recognise and open files of one format."""

    words: str
    matches: Callable[[Path, bytes], bool]
    """Whether a file that starts with these bytes has this format."""
    open: Callable[[Path, Choices], Source]
    frames: Callable[[Path], CameraFrames] | None = None
    """Read the frames that the camera recorded beside its events; None for formats without frames."""
    parts: bool = False
    """Whether a file can hold several recordings, of which `part` names one."""


def signature(start: bytes) -> Callable[[Path, bytes], bool]:
    """A check of whether a file starts with these bytes."""
    return lambda path, head: head.startswith(start)


FORMATS = {
    **{
        name: Format(
            f"HDF5 of {layout.owner}",
            partial(hdf5.matches, layout),
            partial(hdf5.open_hdf5, layout),
            hdf5.e2p_frames if name == "e2p" else None,
            parts=len(layout.parts) > 1,
        )
        for name, layout in hdf5.LAYOUTS.items()
    },
    "rosbag": Format("bags of ROS 1 and ROS 2", rosbag.matches, rosbag.open_rosbag, parts=True),
    "aedat4": Format(
        "AEDAT4 of iniVation",
        signature(b"#!AER-DAT4"),
        partial(faery.open_faery, aedat4=True),
        faery.aedat4_frames,
        parts=True,
    ),
    "aedat3": Format("AEDAT 3.1 of iniVation", signature(aedat.MAGIC_3), aedat.open_aedat3, parts=True),
    "aedat2": Format("AEDAT-2 of jAER, of a DAVIS", signature(aedat.MAGIC_2), aedat.open_aedat2, aedat.aedat2_frames),
    "event_stream": Format("Event Stream (.es)", signature(b"Event Stream"), partial(faery.open_faery, aedat4=False)),
    "evt": Format("EVT2, EVT2.1 and EVT3 of Prophesee", prophesee.matches_evt, prophesee.open_evt),
    "dat": Format("DAT of Prophesee", prophesee.matches_dat, prophesee.open_dat),
    "text": Format("lines `t x y p`", lines.matches_text, lines.open_text),
    "celex5_csv": Format("CSV of a CeleX-5", celex5.matches_csv, celex5.open_csv),
    "celex5_bin": Format("BIN of a CeleX-5", celex5.matches_bin, celex5.open_bin),
}
"""Ordered as they are tried on a file of unknown format."""
PACKABLE = ("aedat3", "aedat2", "evt", "dat", "text", "celex5_csv", "celex5_bin")
"""Formats that are read from gzip and zip archives too."""


@dataclass(frozen=True)
class Recording:
    """The content of a whole file."""

    events: Events
    format: str
    repairs: Mapping[str, int]
    """Count of each repair in `polarnet.recordings.source.REPAIRS` that was needed."""


class RecordingReader:
    """Yields a file's events in chunks, of which the last may be shorter; made by `open_recording`.

    Iterating reads the file from its start in constant memory, and raises RecordingError where the file turns out to be
    damaged. `repairs` counts the repairs up to the latest chunk.
    """

    def __init__(self, path: Path, form: str, blocks: Blocks, sensor: tuple[int, int]):
        self.path = path
        self.format = form
        self.height, self.width = sensor
        self.repairs = Counts()
        self._blocks = blocks

    def __iter__(self) -> Iterator[Events]:
        return self.chunks()

    def chunks(self, size: int = CHUNK_EVENTS, bridged_us: int = 0) -> Iterator[Events]:
        """Iterate with `size` events in a chunk.

        A clock that was set anew in the first `bridged_us` is no error: events go on 10 ms after the newest one.
        """
        self.repairs.clear()
        self.repairs.share_read = 0.0
        sensor = self.height, self.width
        for block in cut(repaired(self.path.name, self._blocks, sensor, self.repairs, bridged_us), size):
            t, x, y, p = map(torch.from_numpy, block)
            yield Events(t, x, y, p, self.height, self.width)


def open_recording(
    path: str | os.PathLike[str],
    format: str | None = None,
    *,
    height: int | None = None,
    width: int | None = None,
    part: str | None = None,
) -> RecordingReader:
    """Open a file to read it chunk by chunk.

    `format` is a key of FORMATS; None detects it from the content. `height` and `width` are needed where the file does
    not state them. `part` is one of several recordings in a file: a topic of a bag, a stream of AEDAT, `left` or
    `right` of M3ED and MVSEC. RecordingError where the format is unknown, has no parts or the content cannot be events;
    RuntimeError naming the package to install where an optional one is missing.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    choices = Choices(height, width, part)
    form = detect_format(path) if format is None else format
    if form not in FORMATS:
        raise ValueError(f"expected a format of {', '.join(FORMATS)}, got {form!r}")
    if part is not None and not FORMATS[form].parts:
        raise RecordingError(f"{path.name}: expected no part, which has no meaning for the format {form}; leave it out")
    if form not in PACKABLE and path.is_file() and _packed(path):
        raise RecordingError(f"{path.name}: expected the format {form} outside an archive; unpack it")
    source = FORMATS[form].open(path, choices)
    sensor = choices.sensor_of(path.name, source.height, source.width)
    return RecordingReader(path, form, source.blocks, sensor)


def read_recording(
    path: str | os.PathLike[str],
    format: str | None = None,
    *,
    height: int | None = None,
    width: int | None = None,
    part: str | None = None,
) -> Recording:
    """Read a whole file, with the arguments and errors of `open_recording`; logs a warning for each kind of damage.

    >>> from pathlib import Path
    >>> from polarnet.recordings import read_recording
    >>> size = Path("night.txt").write_text("40 30\\n0.5 3 2 1\\n")
    >>> read_recording("night.txt").events.x
    tensor([3], dtype=torch.int16)
    """
    reader = open_recording(path, format, height=height, width=width, part=part)
    (events,) = whole(([chunk] for chunk in reader), reader.height, reader.width, 1)
    log_repairs(reader.path.name, reader.repairs)
    return Recording(events, reader.format, {kind: count for kind, count in reader.repairs.items() if count})


def whole(blocks: Iterable[Sequence[Events]], height: int, width: int, number: int) -> list[Events]:
    """All events of `number` channels that come in blocks; they never lie in memory twice."""
    tables = [[np.empty(0, kind) for kind in (np.int64, np.int16, np.int16, np.int8)] for _ in range(number)]
    for block in blocks:
        for columns, events in zip(tables, block, strict=True):
            for column, name in zip(columns, "txyp", strict=True):
                count = len(column)
                column.resize(count + len(events), refcheck=False)
                column[count:] = getattr(events, name).numpy()
    return [Events(t, x, y, p, height, width) for t, x, y, p in (map(torch.from_numpy, columns) for columns in tables)]


def log_repairs(name: str, counts: Counts) -> None:
    """Log a warning for each kind of damage of a file."""
    for kind, count in counts.items():
        if count and kind not in HARMLESS:
            logger.warning("%s: %d %s", name, count, REPAIRS[kind])


def first_time_us(reader: RecordingReader) -> int:
    """Time of the first event; RecordingError for a file without events."""
    for events in reader:
        return int(events.t[0])
    raise RecordingError(f"{reader.path.name}: expected events, the file has none")


def is_recording(path: Path) -> bool:
    """Whether a path is a file, or the folder of a bag."""
    return path.is_file() or (path.is_dir() and rosbag.matches(path, b""))


def detect_format(path: str | os.PathLike[str]) -> str:
    """Detect the format, a key of FORMATS, from a file's first bytes; RecordingError where none matches."""
    path = Path(path)
    head = start_of(path, lines.HEAD_BYTES) if path.is_file() else b""
    if path.is_file() and not head:
        raise RecordingError(f"{path.name}: the file is empty")
    for name, form in FORMATS.items():
        if (name == "rosbag" or head) and form.matches(path, head):  # a bag may be a folder
            return name
    advice = "name a file in it" if path.is_dir() else "if it is one of them, name it as `format` (--format)"
    raise RecordingError(f"{path.name}: its content is of none of the formats {', '.join(FORMATS)}; {advice}")


def _packed(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(ZIP)).startswith((GZIP, ZIP))
