"""Write bags of ROS 1 and ROS 2 with events, for tests of the reader; needs the package rosbags."""

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

ARRAY, PACKET = "dvs_msgs/msg/EventArray", "event_camera_msgs/msg/EventPacket"
DEFINITIONS = {
    "Event": "uint16 x\nuint16 y\n{time} ts\nbool polarity",
    "EventArray": "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events",
    "EventPacket": "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
    "string encoding\nbool is_bigendian\nuint8[] events",
}


def array_bytes(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> bytes:
    """The events of an EventArray as ROS 1 serializes them: their number, then 13 bytes each; t in microseconds."""
    records = np.empty(len(t), [("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
    for name, values in zip(("x", "y", "s", "ns", "p"), (x, y, t // 10**6, t % 10**6 * 1000, p > 0), strict=True):
        records[name] = values
    return struct.pack("<I", len(t)) + records.tobytes()


def two_arrays(rows: Sequence[tuple[int, int, int, int]]) -> list[bytes]:
    """Rows t (microseconds), x, y, p as two messages: all but the last, and the last."""
    return [array_bytes(*np.array(part, int).reshape(-1, 4).T) for part in (rows[:-1], rows[-1:])]


def packet_bytes(encoding: str, time_base: int, content: bytes) -> bytes:
    """An EventPacket as ROS 1 would serialize it, from its number, 0, on."""
    head = struct.pack("<QQI", 0, time_base, len(encoding)) + encoding.encode()
    return head + struct.pack("<?I", False, len(content)) + content


def write_bag(
    path: Path,
    height: int,
    width: int,
    contents: Iterable[bytes],
    topics: Sequence[str] = ("/dvs/events",),
    kind: str = ARRAY,
    plugin: str | None = None,
) -> None:
    """Write a bag with a message in each topic for each of `array_bytes` or `packet_bytes`.

    `plugin` is the storage of ROS 2, SQLITE3 or MCAP; without one the bag is of ROS 1.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if plugin else Stores.ROS1_NOETIC)
    for name, text in DEFINITIONS.items():
        text = text.format(time="builtin_interfaces/Time" if plugin else "time")
        store.register(get_types_from_msg(text, kind.rpartition("/")[0] + f"/{name}"))
    ros2: dict[str, Any] = {"version": 9, "storage_plugin": rosbag2.StoragePlugin[plugin]} if plugin else {}
    with rosbag2.Writer(path, **ros2) if plugin else rosbag1.Writer(path) as bag:
        connections = [bag.add_connection(topic, kind, typestore=store) for topic in topics]
        for k, content in enumerate(contents):
            message = struct.pack("<6I", k, 0, 0, 0, height, width) + content
            for connection in connections:
                bag.write(connection, k, store.ros1_to_cdr(message, kind) if plugin else message)
