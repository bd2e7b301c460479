import gzip
import zipfile

import pytest

from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError


@pytest.mark.parametrize(
    ("text", "t"),
    [
        ("5 1 2 1\n1000001 1 2 1\n", [5, 1_000_001]),
        ("1468941032.229165 1 2 1\n1468941032.2291664 1 2 0\n", [1_468_941_032_229_165, 1_468_941_032_229_166]),
        ("1.468941032229165077e+09 1.0e+00 2.0 1\n1.468941032229166e9 1 2 1e0\n",
         [1_468_941_032_229_165, 1_468_941_032_229_166]),
        ("0.0000005 1 2 1\n0.0000014 1 2 1\n", [1, 1]),
        ("-0.25 1 2 1\n+.5 1 2 1\n", [-250_000, 500_000]),
        ("t,x,y,p\n5,1,2,1\n6;1;2;0\n", [5, 6]),
        ("# a comment\n\n  5\t1 2 1  # late\r\n6 1 2 -1\r\n", [5, 6]),
        ("0 1 2 1\n0 1 2 1\n0.25 1 2 0\n", [0, 0, 250_000]),
        ("1e-05 1 2 1\n3.0000000000000004e-05 1 2 0\n", [10, 30]),
        ("#!events.txt\n# v2e\n1e-05 1 2 1\n2 1 2 0\n", [10, 2_000_000]),
        ("0.000000 1 2 1\n" * 400 + "0.000001 1 2 1\n", [0] * 400 + [1]),
        ("".join(f"{t:.18e} 1 2 1\n" for t in (16e14 + 5, 16e14 + 6)), [1_600_000_000_000_005, 1_600_000_000_000_006]),
        ("".join(f"{t:.1f} 1 2 1\n" for t in (5, 5, 6, 7, 8)), [5, 5, 6, 7, 8]),
        ("3.000000 1 2 1\n4.000000 1 2 1\n", [3_000_000, 4_000_000]),
        ("5 1 2 True\n6 1 2 False\n", [5, 6]),
        ("5 1 2 true\n6 1 2 0\n", [5, 6]),
        ("\ufeff18 12\n5 1 2 1\n6 1 2 0\n", [5, 6]),
    ],
)  # fmt: skip
def test_times_with_a_fraction_are_seconds_and_whole_ones_microseconds(tmp_path, read, text, t):
    (tmp_path / "e.txt").write_text(text, newline="", encoding="utf-8")
    _, (times, x, y, p), _ = read(tmp_path / "e.txt", height=12, width=18)
    assert (times, set(x), set(y), p[0]) == (t, {1}, {2}, 1)


@pytest.mark.parametrize(
    "names",
    [
        "x,y,p,t",
        "# x y polarity timestamp",
        "X;Y;on;time\r",
        '"x","y","pol","timestamp"',
        "xs,ys,polarities,timestamps",
        "col row p ts_us",
        "\ufeffx,y,p,t",
    ],
)
def test_a_first_line_of_names_tells_the_order(tmp_path, read, names):
    (tmp_path / "e.txt").write_text(f"{names}\n1,2,1,0.000005\n3,4,0,0.000006\n", encoding="utf-8")
    assert read(tmp_path / "e.txt", height=12, width=18)[1:] == ([[5, 6], [1, 3], [2, 4], [1, -1]], {})


@pytest.mark.parametrize("first", ["", "%geometry:18,12\n", "# geometry 18x12\n", "x,y,p,t\n", "18 12\n"])
def test_prophesees_csv_has_the_time_last(tmp_path, read, first):
    (tmp_path / "e.csv").write_text(first + "".join(f"{k % 18},{k % 12},{k % 2},{100 + 7 * k}\n" for k in range(50)))
    size = {"height": 12, "width": 18} if first in ("", "x,y,p,t\n") else {}
    form, (t, x, y, p), repairs = read(tmp_path / "e.csv", **size)
    assert (form, t[1], x[:3], y[:3], p[:3], repairs) == (("text", 12, 18), 107, [0, 1, 2], [0, 1, 2], [-1, 1, -1], {})


def test_text_in_a_gzip_or_zip_archive_is_read_and_a_cut_gzip_up_to_the_cut(tmp_path, read):
    content = "18 12\n" + "".join(f"{7 * k} {k % 18} {k * k % 12} 1\n" for k in range(3000))
    (tmp_path / "plain.txt").write_text(content)
    expected = read(tmp_path / "plain.txt")
    packed = gzip.compress(content.encode())
    (tmp_path / "e.txt.gz").write_bytes(packed)
    with zipfile.ZipFile(tmp_path / "e.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("events.txt", content)
        archive.writestr("__MACOSX/._events.txt", "of macOS")
        archive.writestr(".DS_Store", "of macOS")
    assert read(tmp_path / "e.txt.gz") == read(tmp_path / "e.zip") == expected
    (tmp_path / "e.txt.gz").write_bytes(packed[: len(packed) // 2])
    _, (t, *_), repairs = read(tmp_path / "e.txt.gz")
    assert t == expected[1][0][: len(t)]
    assert len(t) > 500
    assert repairs["cut_tail"] >= 1
    (tmp_path / "e.txt.gz").write_bytes(packed[:100] + b"\0" * 20 + packed[120:])
    with pytest.raises(RecordingError, match=r"e\.txt\.gz: the archive cannot be unpacked"):
        read(tmp_path / "e.txt.gz")
    with zipfile.ZipFile(tmp_path / "e.zip", "a") as archive:
        archive.writestr("more.txt", content)
    with pytest.raises(
        RecordingError, match=r"e\.zip: expected one recording in the zip archive, got 2 files; unpack it"
    ):
        read(tmp_path / "e.zip")


@pytest.mark.parametrize(
    ("text", "events", "repairs"),
    [
        ("18 12\n1 2 3 1\n2 2 x 1\n3 2 3 1\n", 2, {"unreadable_lines": 1}),
        ("18 12\n1 2 3 1\n2 2.5 3 1\n3 2 3\n4 1 2 3 1\n9 2 3 1\n", 2, {"unreadable_lines": 3}),
        ("18 12\n1 2 3 1\n99999999999999999999 2 3 1\n1e400 1 1 1\n", 1, {"unreadable_lines": 2}),
        ("18 12\n1 2 3 1\n2 2 3", 1, {"cut_tail": 1}),
        ("18 12\n1 2 3 1\n2 2 \xff 1\n3 2 3 1\n", 2, {"unreadable_lines": 1}),
        ("18 12\n1 2 3 1\n2 2 3 1", 2, {}),
    ],
)
def test_lines_that_are_no_events_are_left_out_and_counted(tmp_path, read, text, events, repairs):
    (tmp_path / "e.txt").write_text(text, encoding="latin-1")
    _, (t, *_), counted = read(tmp_path / "e.txt")
    assert (len(t), counted) == (events, repairs)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1.5 12\n1 2 3 1\n", r"expected a first line `width height`, got '1\.5 12'"),
        ("0 12\n1 2 3 1\n", "expected a sensor with sides of 1 to 32767 px, got 12x0"),
        ("18 12\n1 2 3 1 7\n", "expected lines of the four columns t x y p, got 5 columns"),
        ("18 12\n" + "1 20 3 1\n" * 20, "events that are not on the sensor"),
        (
            "18 12\n" + "1 2 3 1\n1 ? 3 1\n" * 20,
            r"20 lines that are not the numbers .* \(20 events so far\)",
        ),
        ("18 12\n" + "1 " * 10_000, "bytes without the end of a line"),
        ("when,down,right,sign\n1,2,3,1\n", "expected the names t, x, y, p .*, got when, down, right, sign"),
    ],
)
def test_text_of_something_else_is_refused_by_name(tmp_path, text, message):
    (tmp_path / "e.txt").write_text(text)
    with pytest.raises(RecordingError, match=rf"e\.txt: .*{message}"):
        read_recording(tmp_path / "e.txt")
