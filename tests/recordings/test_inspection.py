import cv2
import numpy as np
import pytest

from polarnet.cli import main
from polarnet.events.stream import merge
from polarnet.recordings.inspection import findings, inspect_recording
from polarnet.recordings.recording import open_recording
from polarnet.recordings.source import RecordingError
from studies.celex5_writer import write_celex5_csv, write_celex5_pictures

FACTOR = 4


def test_counts_rates_and_time_are_those_of_the_events(tmp_path, make_random_events):
    events = make_random_events(0, 4000, 2_000_000)
    write_celex5_csv(tmp_path / "e.csv", events)
    inspection = inspect_recording(open_recording(tmp_path / "e.csv", chunk_events=333), FACTOR)
    assert (inspection.format, inspection.counts.shape) == ("celex5_csv", (800, 1280))
    assert (inspection.events, inspection.on) == (4000, int((events.p > 0).sum()))
    assert (inspection.start_us, inspection.stop_us) == (int(events.t[0]), int(events.t[-1]))
    assert inspection.counts[int(events.y[7]), int(events.x[7])] >= 1
    assert not inspection.hot.any()


def test_the_picture_is_of_the_consecutive_events_that_took_the_least_time(tmp_path, columns):
    """On 20 x 10 pixels it shows 30 events: here those of the second 3 ms, all at one pixel."""
    slow = [(1000 * k, k % 20, 2, 1) for k in range(30)]
    quick = [(50_000 + 100 * k, 5, 7, -1) for k in range(30)]
    later = [(100_000 + 1000 * k, k % 20, 3, 1) for k in range(30)]
    path = tmp_path / "e.txt"
    path.write_text("20 10\n" + "".join(f"{t} {x} {y} {p}\n" for t, x, y, p in slow + quick + later))
    inspection = inspect_recording(open_recording(path, chunk_events=7), FACTOR)
    assert columns(inspection.busiest) == [[t for t, *_ in quick], [5] * 30, [7] * 30, [-1] * 30]
    assert "busiest     30 events in 2.9 ms from 50,000 us, 10.34 kev/s" in [*findings(inspection)]


def test_findings_say_what_was_repaired_and_how_often(tmp_path):
    (tmp_path / "e.txt").write_text("20 10\n5 2 3 1\n4 2 3 0\n6 2 x 1\n3000000 4 5 1\n")
    lines = "\n".join(findings(inspect_recording(open_recording(tmp_path / "e.txt"), FACTOR)))
    for words in (
        "format      text: lines `t x y p`",
        "sensor      10 x 20 px (height x width)",
        "events      3: 2 ON, 1 OFF",
        "time        4 to 3,000,000 us, 2.999996 s",
        "time jumps  1 pauses of a second or more",
        "repaired    1 events a little earlier than the one before: put in order",
        "repaired    1 lines that are not the numbers",
    ):
        assert words in lines


def test_inspect_prints_the_findings_and_writes_a_picture_without_hot_pixels(
    tmp_path, make_events, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    edge = make_events([(k, k % 50, 20, 1 - 2 * (k % 2)) for k in range(100)], 800, 1280)
    hot = make_events([(k, 700, 300, 1) for k in range(100)], 800, 1280)
    write_celex5_csv(tmp_path / "capture.csv", merge([edge, hot]))
    assert main(["inspect", "capture.csv"]) == 0
    printed = capsys.readouterr().out
    assert "hot pixels  1 with 50.0% of the events (x 700 y 300: 100)" in printed
    picture = cv2.imread(str(tmp_path / "outputs" / "inspect" / "capture.csv.png"))
    assert picture.shape == (800, 1280, 3)
    coloured = np.argwhere((picture != 255).any(axis=-1))
    assert np.unique(coloured[:, 0]).tolist() == [20]


def test_inspect_of_pictures_shows_the_first(tmp_path, capsys):
    picture = np.zeros((800, 1280), np.uint16)
    picture[:, 640:] = 4095
    write_celex5_pictures(tmp_path / "p.bin", [picture, np.zeros_like(picture)], [0, 33_000])
    assert main(["inspect", str(tmp_path / "p.bin"), "--out", str(tmp_path / "out")]) == 0
    assert "pictures    2" in capsys.readouterr().out
    assert cv2.imread(str(tmp_path / "out" / "p.bin.png"))[400, [10, 1000], 0].tolist() == [0, 255]


def test_empty_rows_and_the_longest_silence_are_named(tmp_path):
    times = [100 * k + (40_000 if k >= 3000 else 0) for k in range(6000)]
    rows = [0, 1, 2, 5, 7]
    lines = "".join(f"{t} {k % 20} {rows[k % 5]} 1\n" for k, t in enumerate(times))
    (tmp_path / "e.txt").write_text("20 8\n" + lines)
    lines = [*findings(inspect_recording(open_recording(tmp_path / "e.txt"), FACTOR))]
    assert "empty rows  3 of 8 without any event" in lines
    assert "gap         at most 40,100 us without events from 299,900 us" in lines


def test_the_start_of_a_simulated_camera_is_not_its_busiest_moment(shared):
    """Nearly all 76,800 pixels of this file fire ON at time 0; its times are whole milliseconds."""
    path = shared / "data" / "recordings" / "event_stream" / "dvs.es"
    inspection = inspect_recording(open_recording(path), FACTOR)
    assert inspection.busiest.t[0] > inspection.start_us
    assert len(inspection.busiest) / (inspection.busiest.t[-1] - inspection.busiest.t[0]) < 0.6  # events a microsecond
    assert len(inspection.busiest.y.unique()) > 80


def test_a_sensor_larger_than_any_is_refused(tmp_path):
    (tmp_path / "e.txt").write_text("32767 32767\n1 2 3 1\n")
    with pytest.raises(RecordingError, match="expected a sensor of at most 16,777,216 pixels, got 32767x32767"):
        inspect_recording(open_recording(tmp_path / "e.txt"), FACTOR)
