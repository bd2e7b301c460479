"""Events over a network stream of dv-processing, from this machine to itself."""

import socket
import sys
import threading
import time

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


def test_events_sent_over_loopback_arrive_in_their_channels(dv, make_random_events):
    events, port = make_random_events(0, 5000, 10**6, 6, 8), free_port()
    writer = dv.io.NetworkWriter("127.0.0.1", port, dv.io.Stream.EventStream(0, "events", "DAVIS346_test", (8, 6)))
    camera = LiveCamera(f"dv://127.0.0.1:{port}", MOSAIC, idle_s=100.0)
    assert (camera.height, camera.width) == (3, 4)

    def send():
        while writer.getClientCount() == 0:
            time.sleep(0.01)
        for start in range(0, len(events), 1000):
            store = dv.EventStore()
            for row in zip(*(getattr(events, name)[start : start + 1000].tolist() for name in "txyp"), strict=True):
                t, x, y, p = row
                store.push_back(1_700_000_000_000_000 + t, x, y, p > 0)
            writer.writeEvents(store)
            time.sleep(0.02)

    thread = threading.Thread(target=send)
    thread.start()
    pieces, received = [], 0
    for piece in camera:
        pieces.append(piece)
        received += sum(map(len, piece.channels))
        if received == len(events):
            break
    thread.join()
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
