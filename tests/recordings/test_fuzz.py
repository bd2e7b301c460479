"""Damaged files of every format end in events or in a RecordingError, and in nothing else.

POLARNET_FUZZ_CASES sets how many for each reader; tests/benchmarks/fuzz_recordings.py runs 10 000 and counts them.
"""

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from polarnet.events.exchange import write_hdf5, write_text
from polarnet.events.store import EventStore
from polarnet.events.stream import slice_count, validate
from polarnet.recordings.formats.celex5_bin import celex5_pictures
from polarnet.recordings.formats.celex5_bin_writer import write_celex5_bin
from polarnet.recordings.formats.celex5_csv import write_celex5_csv
from polarnet.recordings.recording import FORMATS, open_recording
from polarnet.recordings.source import REPAIRS, RecordingError

CASES = int(os.environ.get("POLARNET_FUZZ_CASES", "150"))
EVENTS = 60

FUZZ = settings(
    max_examples=CASES, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
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


def damaged(content: bytes, damage) -> bytes:
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


def write_sample(form: str, folder: Path, events) -> Path:
    """A small, sound file; for a store the file in it that is to be damaged is chosen later."""
    path = folder / f"sample.{form}"
    if form == "store":
        store = EventStore.create(path, ["lake"], events.height, events.width, {})
        store.write("lake", [slice_count(events, 0, k) for k in (EVENTS, 5, 0, EVENTS)], 400_000)
        store.finish()
    elif form == "dsec":
        write_hdf5(path, events, 400_000)
    elif form == "e2p":
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            file["events"] = np.stack([events.t, events.x, events.y, events.p > 0], axis=1).astype(np.uint32)
            file.attrs["sensor_resolution"] = (events.width, events.height)
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
    elif form == "celex5_csv":
        write_celex5_csv(path, events)
    elif form == "text":
        write_text(path, events, 400_000)
    else:
        write_celex5_bin(path, events)
        content = path.read_bytes()
        packages = [content[16 + start : 16 + start + 7 * 40] + b"\1" for start in (0, 7 * 40)]
        path.write_bytes(content[:12] + b"".join(struct.pack("<I", len(package)) + package for package in packages))
    return path


def read_to_the_end(path: Path, form: str | None, chunk_events: int) -> None:
    """What every reader owes whatever it is given."""
    try:
        reader = open_recording(path, form, part="lake/135", assume_polarity=1, chunk_events=chunk_events)
        before = None
        for events in reader:
            validate(events)
            assert before is None or events.t[0] >= before
            before = events.t[-1]
        assert set(reader.repairs) <= set(REPAIRS)
        if reader.format == "celex5_bin":
            for picture in celex5_pictures(path):
                assert picture.intensity.shape == (800, 1280)
    except RecordingError as error:
        assert path.name in str(error)  # noqa: PT017


@pytest.mark.parametrize("form", FORMATS)
def test_a_damaged_file_ends_in_events_or_in_the_reason(form, tmp_path, make_random_events, record_property):
    sample = write_sample(form, tmp_path, make_random_events(0, EVENTS, 300_000, 260, 346))
    files = sorted(path for path in sample.rglob("*") if path.is_file()) if sample.is_dir() else [sample]
    sound = [file.read_bytes() for file in files]
    read_to_the_end(sample, form, 10)
    cases = 0

    @settings(
        max_examples=CASES, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(DAMAGE, st.integers(0, len(files) - 1), st.booleans(), st.integers(1, 100))
    def one_case(damage, number, says_format, chunk_events):
        nonlocal cases
        files[number].write_bytes(damaged(sound[number], damage))
        read_to_the_end(sample, form if says_format else None, chunk_events)
        files[number].write_bytes(sound[number])
        cases += 1

    one_case()
    record_property("form", form)
    record_property("cases", cases)


@pytest.mark.parametrize("form", ["text", "celex5_csv"])
def test_lines_of_anything_end_in_events_or_in_the_reason(form, tmp_path):
    number = st.one_of(
        st.integers(-5, 2000).map(str), st.floats().map(str), st.integers().map(str), st.text(max_size=4)
    )
    line = st.lists(number, max_size=6)

    @settings(
        max_examples=CASES, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(st.lists(line, max_size=30), st.sampled_from([" ", ",", ", ", "\t"]), st.booleans())
    def one_case(lines, separator, says_format):
        path = tmp_path / "lines"
        path.write_text("\n".join(separator.join(words) for words in lines), encoding="utf-8", errors="replace")
        read_to_the_end(path, form if says_format else None, 7)

    one_case()
