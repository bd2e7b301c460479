"""Damaged files of every format end in events or in a RecordingError, and in nothing else.

tests/conftest.py says how many for each reader; `python -m studies.faults` runs more and counts them.
"""

from collections import Counter

import pytest
from damaged_files import DAMAGE, ENDINGS, EVENTS, Sample, ending
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from polarnet.recordings.recording import FORMATS

FUZZ = settings(deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
CASES = FUZZ.max_examples


@pytest.mark.parametrize("form", FORMATS)
def test_a_damaged_file_ends_in_events_or_in_the_reason(form, tmp_path, make_random_events):
    sample = Sample(form, tmp_path, make_random_events(0, EVENTS, 300_000, 260, 346))
    assert sample.ending([], 0, True, 10) == "read"
    endings: Counter[str] = Counter()

    @FUZZ
    @given(DAMAGE, st.integers(0, 50), st.booleans(), st.integers(1, 100))
    def one_case(damage, number, says_format, chunk_events):
        endings[sample.ending(damage, number, says_format, chunk_events)] += 1

    one_case()
    assert set(endings) <= set(ENDINGS)
    assert endings.total() >= CASES
    assert endings["refused"] > CASES // 20
    assert endings["read"] + endings["repaired"] > 0


@pytest.mark.parametrize("form", ["text", "celex5_csv"])
def test_lines_of_anything_end_in_events_or_in_the_reason(form, tmp_path):
    number = st.one_of(
        st.integers(-5, 2000).map(str), st.floats().map(str), st.integers().map(str), st.text(max_size=4)
    )
    line = st.lists(number, max_size=6)
    path = tmp_path / "lines"
    endings: Counter[str] = Counter()

    @FUZZ
    @given(st.lists(line, max_size=30), st.sampled_from([" ", ",", ", ", "\t"]), st.booleans())
    def one_case(lines, separator, says_format):
        path.write_text("\n".join(separator.join(words) for words in lines), encoding="utf-8", errors="replace")
        endings[ending(path, form if says_format else None, 7)] += 1

    one_case()
    assert set(endings) <= set(ENDINGS)
    assert endings.total() >= CASES
    assert endings["refused"] > CASES // 20
