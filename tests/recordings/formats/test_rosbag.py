"""Bags of ROS 1 and 2, written by the package rosbags."""

import sys

import numpy as np
import pytest

from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError
from studies.recording_files import PACKET, packet_bytes, two_arrays, write_bag

EVENTS = [(5, 3, 4, 1), (1_000_009, 7, 0, -1), (1_000_010, 0, 5, 1)]


@pytest.fixture
def rosbags():
    return pytest.importorskip("rosbags", reason="the extra rosbag is not installed")


def write(path, topics=("/dvs/events",), package="dvs_msgs", plugin=None):
    write_bag(path, 6, 8, two_arrays(EVENTS), topics, f"{package}/msg/EventArray", plugin)
    return path


@pytest.mark.parametrize(
    ("name", "package", "plugin"), [("e.bag", "dvs_msgs", None), ("e", "prophesee_event_msgs", "SQLITE3")]
)
def test_events_of_a_bag_arrive_in_microseconds_with_the_sensors_size(rosbags, tmp_path, read, name, package, plugin):
    path = write(tmp_path / name, package=package, plugin=plugin)
    assert read(path) == (("rosbag", 6, 8), np.array(EVENTS).T.tolist(), {"pauses": 1})


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("count", [1, 2, 3, 50])
def test_a_file_of_a_bag_of_ros_2_is_read_alone(rosbags, tmp_path, read, plugin, count):
    rows = [(10 * k, k % 8, k % 6, 1 - 2 * (k % 3 == 0)) for k in range(count)]
    write_bag(tmp_path / "e", 6, 8, two_arrays(rows), plugin=plugin)
    (path,) = [path for path in (tmp_path / "e").iterdir() if path.suffix in (".db3", ".mcap")]
    assert read(path) == (("rosbag", 6, 8), np.array(rows).T.tolist(), {})


LIBCAER = [0x0001, 0x1002, 0x2005, 0x3807, 0x1003, 0x3006, 0x2009, 0x4803, 0x5005, 0x0002, 0x3001]
"""Times 4096 + 2: pixel 5 7 ON; + 3: 5 6 OFF, 9 3 and 9 5 ON; 8192 + 3: 9 1 OFF."""
PACKETS = {
    "evt3": (
        [(0, np.array([0x8001, 0x6002, 0x0004, 0x2803], "<u2")), (0, np.array([0x6003, 0x2007], "<u2"))],
        [[4098, 4099], [3, 7], [4, 4], [1, -1]],
    ),
    "evt2": ([(0, np.array([8 << 28 | 100, 1 << 28 | 5 << 22 | 7 << 11 | 4], "<u4"))], [[6405], [7], [4], [1]]),
    "mono": (
        [(5_000_000, np.array([1 << 63 | 4 << 48 | 3 << 32 | 2500, 5 << 48 | 7 << 32 | 4000], "<u8"))],
        [[5002, 5004], [3, 7], [4, 5], [1, -1]],
    ),
    "libcaer": (
        [(9_000, np.array([3 << 17 | 4 << 2 | 2 | 1, 5, 7 << 17 | 5 << 2 | 1, 6], "<u4"))],
        [[14, 15], [3, 7], [4, 5], [1, -1]],
    ),
    "libcaer_cmp": (
        [(1_000_000, np.array(LIBCAER, "<u2"))],
        [[1_004_098, *[1_004_099] * 3, 1_008_195], [5, 5, 9, 9, 9], [7, 6, 3, 5, 1], [1, -1, 1, 1, -1]],
    ),
}


@pytest.mark.parametrize("encoding", PACKETS)
def test_packets_of_event_camera_msgs_worked_out_by_hand(rosbags, tmp_path, read, encoding):
    packets, columns = PACKETS[encoding]
    contents = [packet_bytes(encoding, base, words.tobytes()) for base, words in packets]
    write_bag(tmp_path / "e", 8, 10, contents, kind=PACKET, plugin="MCAP")
    assert read(tmp_path / "e") == (("rosbag", 8, 10), columns, {})


def test_packets_of_another_encoding_are_refused(rosbags, tmp_path):
    contents = [packet_bytes("evt3", 0, bytes(4)), packet_bytes("trigger", 0, bytes(8))]
    write_bag(tmp_path / "e", 8, 10, contents, kind=PACKET, plugin="MCAP")
    with pytest.raises(RecordingError, match=r"expected packets of one encoding of evt3, .*, got 'trigger'"):
        read_recording(tmp_path / "e")


def test_a_bag_of_several_topics_needs_the_topic(rosbags, tmp_path):
    path = write(tmp_path / "e.bag", ("/left", "/right"))
    with pytest.raises(RecordingError, match=r"say which topic of events to read, --part with one of /left, /right"):
        read_recording(path)
    assert len(read_recording(path, part="/right").events) == 3
    with pytest.raises(
        RecordingError, match=r"expected a topic of EventArray .* got only /e \(other_msgs/msg/EventArray\)"
    ):
        read_recording(write(tmp_path / "e", ("/e",), "other_msgs", "SQLITE3"))


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
