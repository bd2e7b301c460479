"""Files of every format, damaged by chance, and how reading one ends."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from polarnet.events.stream import Events, slice_count, validate
from polarnet.recordings.formats.celex5 import celex5_pictures
from polarnet.recordings.recording import open_recording
from polarnet.recordings.source import REPAIRS, RecordingError
from polarnet.recordings.writers import write_hdf5, write_text
from polarnet.storage.events import EventStore
from studies.celex5_writer import write_celex5_bin, write_celex5_csv
from studies.rosbag_writer import write_bag

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

COLUMNS = {"esfp": "{}", "monash": "events/{}s", "m3ed": "prophesee/right/{}"}
"""Tables of columns in HDF5 without the sensor's size."""

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
        sizeless = form in (*COLUMNS, "mvsec")
        self._size = {"height": events.height, "width": events.width} if sizeless else {}
        self.path = folder / f"sample.{'bag' if form == 'rosbag' else form}"
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
        outcome = ending(self.path, self.form if says_format else None, chunk_events, **self._size)
        self._files[number].write_bytes(self.sound[number])
        return outcome


def write_sample(form: str, path: Path, events: Events) -> None:
    """Write events to a file, or a folder, of a format; skips the test that asks where its library is missing."""
    if form == "store":
        store = EventStore.create(path, ["lake"], events.height, events.width, {})
        store.write("lake", [slice_count(events, 0, k) for k in (EVENTS, 5, 0, EVENTS)], 400_000)
        store.finish()
    elif form == "dsec":
        write_hdf5(path, events, 400_000)
    elif form in COLUMNS or form in ("e2p", "mvsec", "metavision"):
        h5py = pytest.importorskip("h5py")
        columns = {"t": events.t, "x": events.x, "y": events.y, "p": events.p > 0}
        with h5py.File(path, "w") as file:
            if form == "e2p":
                file["events"] = np.stack([*columns.values()], axis=1).astype(np.uint32)
                file.attrs["sensor_resolution"] = (events.width, events.height)
            elif form == "mvsec":
                file["davis/left/events"] = np.stack([columns[name] * 1.0 for name in "xytp"], axis=1)
            elif form in COLUMNS:
                for name, column in columns.items():
                    file[COLUMNS[form].format(name)] = column.numpy()
            else:
                kinds = {"x": "<u2", "y": "<u2", "p": "<i2", "t": "<i8"}
                table = np.zeros(len(events), [*kinds.items()])
                for name in kinds:
                    table[name] = columns[name].numpy()
                file["CD/events"] = table
                file.attrs["geometry"] = f"{events.width}x{events.height}"
    elif form == "rosbag":
        pytest.importorskip("rosbags", reason="the extra rosbag is not installed")
        rows = list(zip(*(getattr(events, name).tolist() for name in "txyp"), strict=True))
        write_bag(path, rows, events.height, events.width)
    elif form in ("aedat4", "event_stream"):
        faery = pytest.importorskip("faery")
        rows = np.array(list(zip(events.t, events.x, events.y, events.p > 0, strict=True)), faery.EVENTS_DTYPE)
        written = path.with_suffix({"aedat4": ".aedat4", "event_stream": ".es"}[form])
        faery.events_stream_from_array(rows, (events.width, events.height)).to_file(written)
        written.rename(path)
    elif form == "evt":
        words = [0x8000]
        for t, x, y, p in zip(*(getattr(events, name).tolist() for name in "txyp"), strict=True):
            words += [0x8000 | t >> 12, 0x6000 | t & 0xFFF, y, 0x2000 | (p > 0) << 11 | x]
        header = f"% evt 3.0\n% geometry {events.width}x{events.height}\n".encode()
        path.write_bytes(header + np.array(words, "<u2").tobytes())
    elif form == "dat":
        words = np.stack([events.t, events.x.long() | events.y.long() << 14 | (events.p > 0).long() << 28], axis=1)
        header = f"% Version 2\n% Height {events.height}\n% Width {events.width}\n".encode()
        path.write_bytes(header + b"\x0c\x08" + words.astype("<u4").tobytes())
    elif form == "aedat3":
        data = 1 | (events.p > 0).long() << 1 | events.y.long() << 2 | events.x.long() << 17
        header = struct.pack("<2h6i", 1, 0, 8, 4, 0, *[len(events)] * 3)
        words = np.stack([data, events.t], axis=1).astype("<u4").tobytes()
        path.write_bytes(b"#!AER-DAT3.1\n#Source 0: DAVIS346\n#!END-HEADER\n" + header + words)
    elif form == "aedat2":
        x, y = events.width - 1 - events.x.long(), events.height - 1 - events.y.long()  # events count from the right
        address = y << 22 | x << 12 | (events.p > 0).long() << 11
        header = b"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.Davis346blue\r\n"
        path.write_bytes(header + np.stack([address, events.t], axis=1).astype(">u4").tobytes())
    elif form == "celex5_csv":
        write_celex5_csv(path, events)
    elif form == "text":
        write_text(path, events, 400_000)
    elif form == "celex5_bin":
        write_celex5_bin(path, events)
        content = path.read_bytes()
        packages = [content[16 + start : 16 + start + 7 * 40] + b"\1" for start in (0, 7 * 40)]
        path.write_bytes(content[:12] + b"".join(struct.pack("<I", len(package)) + package for package in packages))
    else:
        raise ValueError(f"no sample of format {form!r}: write one here")


def ending(path: Path, form: str | None, chunk_events: int, **size: int) -> str:
    """One of ENDINGS. Whatever else a reader does (another error, events out of order, an unnamed file) is raised."""
    try:
        part = "lake/135" if path.is_dir() else None  # of an event store
        reader = open_recording(path, form, part=part, chunk_events=chunk_events, **size)
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
