"""Recordings for Rerun hold what was logged."""

import subprocess
import sys

import pytest
import torch

from polarnet.events.stream import Events
from polarnet.reports.rerun_log import RerunLog, log_sequence
from polarnet.stokes import Prediction
from polarnet.storage.events import EventStore

rerun = pytest.importorskip("rerun")


def entities(path):
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(path)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.fixture
def store(tmp_path):
    """Sequence of 0.1 s with one event behind each polarizer."""
    writer = EventStore.create(tmp_path / "events.zarr", ["lake"], 4, 6, {})
    types = torch.int16, torch.int16, torch.int8
    one = Events(torch.tensor([500]), *(torch.tensor([1], dtype=dtype) for dtype in types), 4, 6)
    writer.write("lake", [one] * 4, 100_000)
    writer.finish()
    return tmp_path / "events.zarr"


def test_events_of_a_sequence_are_logged_by_window(store, tmp_path):
    log_sequence(store, None, tmp_path / "lake.rrd")
    printed = entities(tmp_path / "lake.rrd")
    assert "/events_per_window" in printed
    assert "/true/DoLP" not in printed


def test_predictions_have_their_expected_errors_and_timings(tmp_path):
    with RerunLog(tmp_path / "x.rrd", "x") as log:
        log.prediction(1000, Prediction(*[torch.zeros(4, 6)] * 3), 0.001, None)
    printed = entities(tmp_path / "x.rrd")
    assert all(name in printed for name in ("/DoLP", "/AoLP", "/expected_error", "/timing/step_ms"))
    assert "/timing/latency_ms" not in printed


def test_an_unknown_sequence_lists_those_there_are(store, tmp_path):
    with pytest.raises(ValueError, match="expected a sequence of lake; got 'road'"):
        log_sequence(store, "road", tmp_path / "lake.rrd")
