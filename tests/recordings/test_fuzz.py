"""Damaged files of every format end in events or in a RecordingError, and in nothing else.

tests/conftest.py says how many for each reader; `python -m studies.faults` damages the artefacts of the pipeline.
"""

import struct
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from polarnet.events.stream import validate
from polarnet.recordings.formats.celex5 import celex5_pictures
from polarnet.recordings.recording import FORMATS, open_recording
from polarnet.recordings.source import REPAIRS, RecordingError
from studies.recording_files import FILES

FUZZ = settings(deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
CASES = FUZZ.max_examples
PLACES = st.one_of(st.integers(0, 200), st.integers(0, 2**20))
CODES = [bytes([code]) for code in b"\0\n ,-.09e\x7f\xff"]
BYTES = st.one_of(st.binary(max_size=12), st.sampled_from(CODES), st.just(b"?\n" * 20))  # 20 lines: too many to repair
DAMAGE = st.lists(st.tuples(PLACES, st.sampled_from([0, 1, 2, 7, 40, 2**20]), BYTES), max_size=6)
"""Changes of a file in order: byte, number of bytes removed there, and bytes inserted instead."""


def write_sample(form: str, path: Path, events) -> dict[Path, bytes]:
    """Write a recording of a format; its files, and their content. Skips the test where the library is missing."""
    try:
        FILES[form][1](path, events)
    except ImportError as error:
        pytest.skip(f"the extra recordings is not installed: {error}")
    if form == "celex5_bin":  # two packages of 40 groups of 7 bytes instead of one of 51,000
        content = path.read_bytes()
        packages = [content[16 + start : 16 + start + 7 * 40] + b"\1" for start in (0, 7 * 40)]
        path.write_bytes(content[:12] + b"".join(struct.pack("<I", len(package)) + package for package in packages))
    return {file: file.read_bytes() for file in sorted([path, *path.rglob("*")]) if file.is_file()}


def ending(path: Path, form: str | None, size: int) -> str:
    """Whether a file is read, repaired or refused. Whatever else a reader does is raised."""
    try:
        reader = open_recording(path, form)
        before = None
        for events in reader.chunks(size):
            validate(events)
            assert before is None or events.t[0] >= before
            before = events.t[-1]
        assert set(reader.repairs) <= set(REPAIRS)
        if reader.format == "celex5_bin":
            assert all(picture.intensity.shape == (800, 1280) for picture in celex5_pictures(path))
    except RecordingError as error:
        return "refused" if path.name in str(error) else f"refused without its name: {error}"
    return "repaired" if any(reader.repairs.values()) else "read"


@pytest.mark.thorough
@pytest.mark.parametrize("form", FORMATS)
def test_a_damaged_file_ends_in_events_or_in_the_reason(form, tmp_path, make_random_events):
    path = tmp_path / f"sample{FILES[form][0]}"
    sound = write_sample(form, path, make_random_events(0, 60, 300_000, 260, 346))
    assert ending(path, form, 10) == "read"
    endings: Counter[str] = Counter()

    @FUZZ
    @given(DAMAGE, st.sampled_from([*sound]), st.booleans(), st.integers(1, 100))
    def one_case(damage, file, says_format, size):
        content = sound[file]
        for place, removed, inserted in damage:
            place %= max(1, len(content))
            content = content[:place] + inserted + content[place + removed :]
        file.write_bytes(content)
        endings[ending(path, form if says_format else None, size)] += 1
        file.write_bytes(sound[file])

    one_case()
    assert endings.total() >= CASES
    assert set(endings) <= {"read", "repaired", "refused"}
    assert endings["refused"] > CASES // 20
    assert endings["read"] + endings["repaired"] > 0
