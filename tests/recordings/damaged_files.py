"""Files of every format, damaged by chance, and how reading one ends."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import strategies as st

from polarnet.events.stream import Events, validate
from polarnet.recordings.formats.celex5 import celex5_pictures
from polarnet.recordings.recording import open_recording
from polarnet.recordings.source import REPAIRS, RecordingError
from studies.recording_files import FILES

EVENTS = 60
PLACES = st.one_of(st.integers(0, 200), st.integers(0, 2**20))
DAMAGE = st.lists(
    st.one_of(
        st.tuples(st.just("flip"), PLACES, st.integers(0, 7)),
        st.tuples(st.just("set"), PLACES, st.sampled_from([0, 10, 32, 44, 45, 46, 48, 57, 101, 127, 255])),
        st.tuples(st.just("cut"), PLACES, st.just(0)),
        st.tuples(st.just("delete"), PLACES, st.integers(1, 40)),
        st.tuples(st.just("repeat"), PLACES, st.integers(1, 200)),
        st.tuples(st.just("insert"), PLACES, st.binary(min_size=1, max_size=12)),
    ),
    max_size=6,
)
"""Changes of a file in order: kind, byte, and value."""

ENDINGS = ("read", "repaired", "refused")
"""The only three that reading a file may have: as it is, with repairs that are counted, or with the reason not to."""


def damaged(content: bytes, damage: Sequence[tuple[str, int, Any]]) -> bytes:
    """The content of a file after DAMAGE."""
    for kind, place, what in damage:
        place %= max(1, len(content))
        head, tail = content[:place], content[place:]
        if kind == "flip" and tail:
            tail = bytes([tail[0] ^ 1 << what]) + tail[1:]
        elif kind == "set":
            tail = bytes([what]) + tail[1:]
        elif kind == "cut":
            tail = b""
        elif kind == "delete":
            tail = tail[what:]
        elif kind == "repeat":
            tail = tail[:what] + tail
        elif kind == "insert":
            tail = what + tail
        content = head + tail
    return content


class Sample:
    """A small, sound recording of a format in a folder, of one file or several."""

    def __init__(self, form: str, folder: Path, events: Events):
        self.form = form
        self.path = folder / f"sample{FILES[form][0]}"
        write_sample(form, self.path, events)
        self._files = sorted(path for path in [self.path, *self.path.rglob("*")] if path.is_file())
        self.sound = [file.read_bytes() for file in self._files]

    def ending(self, damage: Sequence[tuple[str, int, Any]], number: int, says_format: bool, chunk_events: int) -> str:
        """Damage file `number`, counted round, read the recording, and put the file right again."""
        number %= len(self._files)
        return self.ending_of(damaged(self.sound[number], damage), number, says_format, chunk_events)

    def ending_of(self, content: bytes, number: int, says_format: bool, chunk_events: int) -> str:
        """The ending with other content of file `number`, which is put right again."""
        self._files[number].write_bytes(content)
        outcome = ending(self.path, self.form if says_format else None, chunk_events)
        self._files[number].write_bytes(self.sound[number])
        return outcome


def write_sample(form: str, path: Path, events: Events) -> None:
    """Write events to a file, or a folder, of a format; skips the test that asks where its library is missing."""
    try:
        FILES[form][1](path, events)
    except ImportError as error:
        pytest.skip(f"the extra recordings is not installed: {error}")
    if form == "celex5_bin":  # two packages of 40 groups of 7 bytes instead of one of 51,000
        content = path.read_bytes()
        packages = [content[16 + start : 16 + start + 7 * 40] + b"\1" for start in (0, 7 * 40)]
        path.write_bytes(content[:12] + b"".join(struct.pack("<I", len(package)) + package for package in packages))


def ending(path: Path, form: str | None, chunk_events: int) -> str:
    """One of ENDINGS. Whatever else a reader does (another error, events out of order, an unnamed file) is raised."""
    try:
        reader = open_recording(path, form, chunk_events=chunk_events)
        before = None
        for events in reader:
            validate(events)
            if before is not None and events.t[0] < before:
                raise AssertionError(f"events of {events.t[0]} us come after events of {before} us")
            before = events.t[-1]
        if unknown := set(reader.repairs) - set(REPAIRS):
            raise AssertionError(f"repairs that nothing explains: {unknown}")
        if reader.format == "celex5_bin" and any(p.intensity.shape != (800, 1280) for p in celex5_pictures(path)):
            raise AssertionError("a picture of another size than the sensor's")
    except RecordingError as error:
        if path.name not in str(error):
            raise AssertionError(f"the reason names no file: {error}") from error
        return "refused"
    return "repaired" if any(reader.repairs.values()) else "read"
