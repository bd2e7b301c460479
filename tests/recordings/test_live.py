"""Lines from a pipe or a file that grows, and a network stream of dv-processing from this machine to itself."""

import contextlib
import os
import select
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch

from polarnet.recordings.live import live_lines, read_camera, read_lines
from polarnet.recordings.source import RecordingError
from polarnet.stokes import parse_mosaic

MOSAIC = parse_mosaic("90 45 / 135 0")


def filled(live):
    """Pieces with events; others say that what arrived gave none yet."""
    return (piece for piece in live.pieces if any(map(len, piece.channels)))


def read_text(tmp_path, text, mosaic=None):
    path = tmp_path / "camera.txt"
    path.write_text(text)
    with path.open("rb") as file:
        live = read_lines(file, path.name, mosaic)
        pieces = list(filled(live))
        assert file.closed
        return live, pieces


@contextlib.contextmanager
def pipe():
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as source, os.fdopen(writer, "wb", buffering=0) as camera:
        yield source, camera


def test_what_is_written_as_lines_is_read_back_and_a_mosaic_gives_pixels_to_polarizers(
    tmp_path, make_random_events, columns
):
    channels = [make_random_events(seed, 200, 10_000, 20, 30) for seed in range(4)]
    head, times, lines = live_lines(channels)
    live, pieces = read_text(tmp_path, (head + lines).decode())
    assert (live.height, live.width) == (20, 30)
    assert not +live.repairs[0][1]
    first = int(times[0])
    for k, events in enumerate(channels):
        assert torch.equal(torch.cat([piece.channels[k].t for piece in pieces]), events.t - first)
        for name in "xyp":
            assert torch.equal(torch.cat([getattr(p.channels[k], name) for p in pieces]), getattr(events, name))
    assert pieces[-1].until_us == int(times[-1]) - first
    live, (piece,) = read_text(tmp_path, "4 2\n10 0 0 1\n11 1 0 1\n12 2 1 1\n13 3 1 1\n", MOSAIC)
    assert (live.height, live.width) == (1, 2)
    assert [columns(channel)[:2] for channel in piece.channels] == [[[3], [1]], [[1], [0]], [[0], [0]], [[2], [1]]]


def test_comments_commas_zeros_and_a_last_line_without_an_end_are_read(tmp_path, columns):
    _, pieces = read_text(tmp_path, "4 3\n# t x y p angle\n100,1,2,0,0\n150 3 0 1 135\n160 0 0 -1 90")
    events = [event for piece in pieces for e in piece.channels for event in zip(*columns(e), strict=True)]
    assert sorted(events) == [(0, 1, 2, -1), (50, 3, 0, 1), (60, 0, 0, -1)]
    with pipe() as (source, camera):
        camera.write(b"# a camera\n\n")
        threading.Timer(0.05, camera.write, [b"  # its size\n4 3 # px\n0 0 0 1 0\n"]).start()
        live = read_lines(source, "pipe", None)
        assert (live.height, live.width) == (3, 4)
        assert next(filled(live)).until_us == 0


def test_lines_are_handed_on_as_they_come_and_keep_their_time_while_nobody_reads():
    with pipe() as (source, camera):
        camera.write(b"4 3\n")
        pieces = filled(read_lines(source, "pipe", None))
        camera.write(b"5 0 0 1 0\n9 1 1 1 45\n12 ")
        assert next(pieces).until_us == 4
        camera.write(b"0 0 1 0\n7 2 2 1 0\n20 2 2 1 90\n")
        assert next(pieces).until_us == 15
        camera.close()
        assert list(pieces) == []
    with pipe() as (source, camera):
        camera.write(b"4 3\n")
        live = read_lines(source, "pipe", None)
        before = time.perf_counter()
        camera.write(b"0 0 0 1 0\n10 0 0 1 0\n")
        while select.select([source], [], [], 0)[0]:
            time.sleep(0.001)
        time.sleep(0.3)  # the reading thread may not have taken the time yet
        after = time.perf_counter()
        camera.close()
        assert all(before <= piece.read_at <= after for piece in filled(live))


def test_what_has_arrived_is_known_and_reading_it_never_waits_for_more():
    with pipe() as (source, camera):
        camera.write(b"4 3\n0 0 0 1 0\n")
        live = read_lines(source, "pipe", None)
        assert next(live.pieces).until_us == 0
        for part_of_a_line in (b"12 ", b"0 0 1"):
            assert not live.unread()
            camera.write(part_of_a_line)
            while not live.unread():
                time.sleep(0.001)
            assert not any(map(len, next(live.pieces).channels))
        camera.write(b" 0\n")
        assert next(live.pieces).until_us == 12


def test_late_events_and_single_bad_lines_are_left_out_and_counted(tmp_path):
    with pipe() as (source, camera):
        camera.write(b"4 3\n100 0 0 1 0\n200 0 0 1 0\n")
        live = read_lines(source, "pipe", None)
        pieces = filled(live)
        assert next(pieces).until_us == 100
        camera.write(b"150 0 0 1 0\n300 9 0 1 0\n300 0 0 3 0\n300 0 0 1 30\nhello\n400 0 0 1 0\n")
        assert next(pieces).until_us == 300
        camera.close()
        assert list(pieces) == []
    ((_, counts),) = live.repairs
    assert +counts == {"late": 1, "out_of_range": 1, "bad_polarity": 1, "bad_angle": 1, "unreadable_lines": 1}


@pytest.mark.parametrize(("text", "reason"), [
    ("", "expected a first line `width height`"), ("hello", "expected a first line"),
    ("0 0 0 1 0\n", "expected a first line `width height`"),
    ("4 3\n" + "1 2 3\n" * 20, r"20 lines that are not the numbers they should be \(20 events so far\)"),
    ("4 3\n" + "1 7 2 1 0\n" * 20, "not on the sensor"),
])  # fmt: skip
def test_what_is_no_such_stream_is_refused(tmp_path, text, reason):
    with pytest.raises(RecordingError, match=reason):
        read_text(tmp_path, text)


def test_an_event_after_a_pause_waits_for_others_but_not_for_long():
    with pipe() as (source, camera):
        camera.write(b"4 3\n0 0 0 1 0\n")
        pieces = filled(read_lines(source, "pipe", None))
        assert next(pieces).until_us == 0
        written = time.perf_counter()
        camera.write(b"500000 0 0 1 0\n")
        piece = next(pieces)
        assert piece.until_us == 500_000
        assert written <= piece.read_at <= time.perf_counter()
        assert time.perf_counter() - written < 1.0


@pytest.fixture
def dv():
    return pytest.importorskip("dv_processing", reason="the extra live is not installed")


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


SENDER = """
import sys, time
import dv_processing as dv
import numpy as np

events, port = np.load(sys.argv[1]), int(sys.argv[2])
writer = dv.io.NetworkWriter("127.0.0.1", port, dv.io.Stream.EventStream(0, "events", "DAVIS346_test", (8, 6)))
while writer.getClientCount() == 0:
    time.sleep(0.01)
for start in range(0, len(events), 1000):
    store = dv.EventStore()
    for t, x, y, p in events[start : start + 1000].tolist():
        store.push_back(1_700_000_000_000_000 + t, x, y, p > 0)
    writer.writeEvents(store)
    time.sleep(0.02)
time.sleep(100)
"""


@pytest.fixture
def sender(dv, tmp_path):
    """Start a process that sends events to the first reader of its port; the writer would wait for it on deletion."""
    started = []

    def start(events):
        np.save(tmp_path / "events.npy", torch.stack([events.t, events.x, events.y, events.p], dim=1).numpy())
        port = free_port()
        started.append(subprocess.Popen([sys.executable, "-c", SENDER, tmp_path / "events.npy", str(port)]))
        return port

    yield start
    for process in started:
        process.kill()
        process.wait()


def connected(port):
    """The camera, once the process has opened its port."""
    for _ in range(200):
        try:
            return read_camera(f"dv://127.0.0.1:{port}", MOSAIC, idle_s=100.0)
        except RecordingError:
            time.sleep(0.1)
    raise AssertionError("the sender did not open its port within 20 s")


def test_events_sent_over_loopback_arrive_in_their_channels(sender, make_random_events):
    events = make_random_events(0, 5000, 10**6, 6, 8)
    camera = connected(sender(events))
    assert (camera.height, camera.width) == (3, 4)
    pieces, received = [], 0
    for piece in camera.pieces:
        pieces.append(piece)
        received += sum(map(len, piece.channels))
        if received == len(events):
            break
    t = torch.cat([channel.t for piece in pieces for channel in piece.channels]).sort().values
    assert torch.equal(t, events.t - events.t[0])
    assert sum(len(piece.channels[2]) for piece in pieces) == int(((events.x % 2 == 0) & (events.y % 2 == 0)).sum())
    assert [piece.until_us for piece in pieces] == sorted(piece.until_us for piece in pieces)
    assert len(pieces) >= 2


def test_without_a_camera_or_dv_processing_the_error_says_so(dv, monkeypatch):
    with pytest.raises(RecordingError, match="cannot be reached"):
        read_camera(f"dv://127.0.0.1:{free_port()}", MOSAIC, idle_s=1.0)
    with pytest.raises(ValueError, match="expected dv://HOST:PORT or dv://camera"):
        read_camera("dv://somewhere", MOSAIC, idle_s=1.0)
    monkeypatch.setitem(sys.modules, "dv_processing", None)
    with pytest.raises(RuntimeError, match=r"run pip install -e '\.\[recordings\]' in the clone"):
        read_camera("dv://127.0.0.1:7777", MOSAIC, idle_s=1.0)
