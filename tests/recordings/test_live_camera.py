"""Events over a network stream of dv-processing, from this machine to itself."""

import socket
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from polarnet.recordings.live_camera import LiveCamera
from polarnet.recordings.source import RecordingError
from polarnet.stokes import parse_mosaic

MOSAIC = parse_mosaic("90 45 / 135 0")


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
            return LiveCamera(f"dv://127.0.0.1:{port}", MOSAIC, idle_s=100.0)
        except RecordingError:
            time.sleep(0.1)
    raise AssertionError("the sender did not open its port within 20 s")


def test_events_sent_over_loopback_arrive_in_their_channels(sender, make_random_events):
    events = make_random_events(0, 5000, 10**6, 6, 8)
    camera = connected(sender(events))
    assert (camera.height, camera.width) == (3, 4)
    pieces, received = [], 0
    for piece in camera:
        pieces.append(piece)
        received += sum(map(len, piece.channels))
        if received == len(events):
            break
    t = torch.cat([events_of_angle.t for piece in pieces for events_of_angle in piece.channels]).sort().values
    assert torch.equal(t, events.t - events.t[0])
    assert sum(len(piece.channels[2]) for piece in pieces) == int(((events.x % 2 == 0) & (events.y % 2 == 0)).sum())
    assert [piece.until_us for piece in pieces] == sorted(piece.until_us for piece in pieces)
    assert len(pieces) >= 2


def test_nobody_at_the_address_is_reported(dv):
    with pytest.raises(RecordingError, match="cannot be reached"):
        LiveCamera(f"dv://127.0.0.1:{free_port()}", MOSAIC, idle_s=1.0)
    with pytest.raises(ValueError, match="expected dv://HOST:PORT or dv://camera"):
        LiveCamera("dv://somewhere", MOSAIC, idle_s=1.0)


def test_without_dv_processing_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "dv_processing", None)
    with pytest.raises(RuntimeError, match=r"run pip install -e '\.\[live\]' in the clone"):
        LiveCamera("dv://127.0.0.1:7777", MOSAIC, idle_s=1.0)
