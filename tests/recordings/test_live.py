"""Lines from a pipe or a file that grows."""

import os
import threading
import time

import pytest
import torch

from polarnet.recordings.live import LiveLines, live_lines
from polarnet.recordings.source import RecordingError
from polarnet.stokes import parse_mosaic


def read(tmp_path, text, mosaic=None):
    path = tmp_path / "camera.txt"
    path.write_text(text)
    with path.open("rb") as file:
        live = LiveLines(file, path.name, mosaic, idle_s=0.0)
        return live, list(live)


def test_what_is_written_as_lines_is_read_back(tmp_path, make_random_events):
    channels = [make_random_events(seed, 200, 10_000, 20, 30) for seed in range(4)]
    head, times, lines = live_lines(channels)
    live, pieces = read(tmp_path, (head + lines).decode())
    assert (live.height, live.width) == (20, 30)
    assert not +live.counts
    first = int(times[0])
    for k, events in enumerate(channels):
        assert torch.equal(torch.cat([piece.channels[k].t for piece in pieces]), events.t - first)
        for name in "xyp":
            assert torch.equal(torch.cat([getattr(p.channels[k], name) for p in pieces]), getattr(events, name))
    assert pieces[-1].until_us == int(times[-1]) - first


def test_a_file_is_closed_at_its_end(tmp_path):
    path = tmp_path / "camera.txt"
    path.write_text("4 3\n100 1 2 0 0\n")
    source = path.open("rb")
    assert len(list(LiveLines(source, path.name, None, idle_s=0.0))) == 1
    assert source.closed


def test_commas_comments_zeros_and_a_last_line_without_an_end_are_read(tmp_path):
    _, pieces = read(tmp_path, "4 3\n# t x y p angle\n100,1,2,0,0\n150 3 0 1 135\n160 0 0 -1 90")
    events = [(int(e.t[k]), int(e.x[k]), int(e.y[k]), int(e.p[k])) for piece in pieces for e in piece.channels
              for k in range(len(e))]  # fmt: skip
    assert sorted(events) == [(0, 1, 2, -1), (50, 3, 0, 1), (60, 0, 0, -1)]


def test_a_mosaic_gives_each_pixel_to_its_polarizer(tmp_path):
    live, (piece,) = read(tmp_path, "4 2\n10 0 0 1\n11 1 0 1\n12 2 1 1\n13 3 1 1\n", parse_mosaic("90 45 / 135 0"))
    assert (live.height, live.width) == (1, 2)
    assert [channel.t.tolist() for channel in piece.channels] == [[3], [1], [0], [2]]
    assert [channel.x.tolist() for channel in piece.channels] == [[1], [0], [0], [1]]


def test_lines_are_handed_on_as_they_come_through_a_pipe():
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as source, os.fdopen(writer, "wb", buffering=0) as camera:
        camera.write(b"4 3\n")
        pieces = iter(LiveLines(source, "pipe", None, idle_s=0.0))
        camera.write(b"5 0 0 1 0\n9 1 1 1 45\n12 ")
        assert next(pieces).until_us == 4
        camera.write(b"0 0 1 0\n7 2 2 1 0\n20 2 2 1 90\n")
        assert next(pieces).until_us == 15
        camera.close()
        assert list(pieces) == []


def test_a_file_that_grows_is_followed(tmp_path):
    path = tmp_path / "camera.txt"
    path.write_text("4 3\n0 0 0 1 0\n")

    def grow():
        for t in (10, 20, 30):
            time.sleep(0.02)
            with path.open("a") as file:
                file.write(f"{t} 0 0 1 0\n")

    with path.open("rb") as source:
        live = LiveLines(source, path.name, None, idle_s=30.0)
        thread = threading.Thread(target=grow)
        thread.start()
        pieces = iter(live)
        until = 0
        while until < 30:
            until = next(pieces).until_us
        thread.join()


def test_late_events_and_single_bad_lines_are_left_out_and_counted(tmp_path):
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as source, os.fdopen(writer, "wb", buffering=0) as camera:
        camera.write(b"4 3\n100 0 0 1 0\n200 0 0 1 0\n")
        live = LiveLines(source, "pipe", None, idle_s=0.0)
        pieces = iter(live)
        assert next(pieces).until_us == 100
        camera.write(b"150 0 0 1 0\n300 9 0 1 0\n300 0 0 3 0\n300 0 0 1 30\nhello\n400 0 0 1 0\n")
        assert next(pieces).until_us == 300
        camera.close()
        assert list(pieces) == []
    assert live.counts == {"late": 1, "out_of_range": 1, "bad_polarity": 1, "bad_angle": 1, "unreadable_lines": 1}


@pytest.mark.parametrize(("text", "reason"), [
    ("", "expected a first line `width height`"), ("hello", "expected a first line"),
    ("0 0 0 1 0\n", "expected a first line `width height`"),
    ("4 3\n" + "1 2 3\n" * 20, "20 of the first 20 lines are lines that are not `t x y p angle`"),
    ("4 3\n" + "1 7 2 1 0\n" * 20, "not on the sensor"),
])  # fmt: skip
def test_what_is_no_such_stream_is_refused(tmp_path, text, reason):
    with pytest.raises(RecordingError, match=reason):
        read(tmp_path, text)


def test_lines_keep_the_time_at_which_they_came_while_nobody_reads():
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as source, os.fdopen(writer, "wb", buffering=0) as camera:
        camera.write(b"4 3\n")
        live = LiveLines(source, "pipe", None, idle_s=0.0)
        before = time.perf_counter()
        camera.write(b"0 0 0 1 0\n10 0 0 1 0\n")
        camera.close()
        while live._queue.qsize() < 2:
            time.sleep(0.001)
        after = time.perf_counter()
        assert all(before <= piece.read_at <= after for piece in live)
