"""Bags of ROS 1 and 2, written by the package rosbags."""

import sys

import numpy as np
import pytest

from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError
from studies.rosbag_writer import write_bag

EVENTS = [(5, 3, 4, 1), (1_000_009, 7, 0, -1), (1_000_010, 0, 5, 1)]


@pytest.fixture
def rosbags():
    return pytest.importorskip("rosbags", reason="the extra rosbag is not installed")


def write(path, topics=("/dvs/events",), form="ros1", package="dvs_msgs"):
    write_bag(path, EVENTS, 6, 8, topics, form, package)
    return path


@pytest.mark.parametrize(("form", "package"), [("ros1", "dvs_msgs"), ("ros2", "prophesee_event_msgs")])
def test_events_of_a_bag_arrive_in_microseconds_with_the_sensors_size(rosbags, tmp_path, read, form, package):
    path = write(tmp_path / ("e.bag" if form == "ros1" else "e"), form=form, package=package)
    assert read(path) == (("rosbag", 6, 8), np.array(EVENTS).T.tolist(), {"pauses": 1})


def test_a_bag_of_several_topics_needs_the_topic(rosbags, tmp_path):
    path = write(tmp_path / "e.bag", ("/left", "/right"))
    with pytest.raises(RecordingError, match=r"or --part TOPIC, got /left, /right"):
        read_recording(path)
    assert len(read_recording(path, part="/right").events) == 3
    path.unlink()
    with pytest.raises(RecordingError, match=r"got only /e \(other_msgs/msg/EventArray\)"):
        read_recording(write(tmp_path / "e.bag", ("/e",), package="other_msgs"))


def test_a_damaged_bag_is_refused(rosbags, tmp_path):
    path = write(tmp_path / "e.bag")
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(RecordingError, match=r"e\.bag: rosbags cannot read it: .*the bag is damaged"):
        read_recording(path)


def test_without_rosbags_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    (tmp_path / "e.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(RuntimeError, match=r"run pip install -e '\.\[recordings\]' in the clone"):
        read_recording(tmp_path / "e.bag")
