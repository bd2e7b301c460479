"""Write bags of ROS 1 and ROS 2 with events, for tests of the reader; needs the package rosbags."""

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

EVENT = "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity"
EVENT_ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events"
EVENT_PACKET = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events"""
ROS1_TIME = "time"


def write_bag(
    path: Path,
    rows: Sequence[tuple[int, int, int, int]],
    height: int,
    width: int,
    topics: Sequence[str] = ("/dvs/events",),
    form: str = "ros1",
    package: str = "dvs_msgs",
    plugin: str = "sqlite3",
) -> None:
    """Write rows t (microseconds), x, y, p to each topic: a message with all but the last, and one with the last.

    `form` is ros1 or ros2; `plugin` the storage of ROS 2, sqlite3 or mcap.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    old = form == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
    for name, text in (("Event", EVENT), ("EventArray", EVENT_ARRAY)):
        own = text.replace("builtin_interfaces/Time", ROS1_TIME) if old else text
        store.register(get_types_from_msg(own, f"{package}/msg/{name}"))
    kinds, array = store.types, f"{package}/msg/EventArray"
    event, time, header = (
        kinds[name] for name in (f"{package}/msg/Event", "builtin_interfaces/msg/Time", "std_msgs/msg/Header")
    )

    def message(some: Sequence[tuple[int, int, int, int]]) -> Any:
        stamp = header(**({"seq": 0} if old else {}), stamp=time(sec=0, nanosec=0), frame_id="")
        events = [
            event(x=x, y=y, ts=time(sec=t // 10**6, nanosec=t % 10**6 * 1000), polarity=p > 0) for t, x, y, p in some
        ]
        return kinds[array](header=stamp, height=height, width=width, events=events)

    serialize = store.serialize_ros1 if old else store.serialize_cdr
    with Writer1(path) if old else Writer2(path, version=9, storage_plugin=StoragePlugin[plugin.upper()]) as bag:
        for topic in topics:
            connection = bag.add_connection(topic, array, typestore=store)
            for k, some in enumerate((rows[:-1], rows[-1:])):
                bag.write(connection, k, serialize(message(some), array))


def array_bytes(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> bytes:
    """The events of an EventArray as ROS 1 serializes them: their number, then 13 bytes each."""
    records = np.empty(len(t), [("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
    for name, values in zip(("x", "y", "s", "ns", "p"), (x, y, t // 10**6, t % 10**6 * 1000, p), strict=True):
        records[name] = values
    return struct.pack("<I", len(t)) + records.tobytes()


def write_arrays(path: Path, height: int, width: int, contents: Iterable[bytes]) -> None:
    """Write a ROS 1 bag with an EventArray of dvs_msgs for each of `array_bytes`."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in (("Event", EVENT), ("EventArray", EVENT_ARRAY)):
        store.register(get_types_from_msg(text.replace("builtin_interfaces/Time", ROS1_TIME), f"dvs_msgs/msg/{name}"))
    with Writer(path) as bag:
        connection = bag.add_connection("/dvs/events", "dvs_msgs/msg/EventArray", typestore=store)
        for k, content in enumerate(contents):
            bag.write(connection, k, struct.pack("<6I", k, 0, 0, 0, height, width) + content)


def write_packets(path: Path, height: int, width: int, packets: Iterable[tuple[str, int, bytes]]) -> None:
    """Write a ROS 2 bag of EventPacket of event_camera_msgs: encoding, time base and content of each."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    name = "event_camera_msgs/msg/EventPacket"
    store.register(get_types_from_msg(EVENT_PACKET, name))
    kinds = store.types
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/event_camera/events", name, typestore=store)
        for k, (encoding, time_base, content) in enumerate(packets):
            stamp = kinds["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
            header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")
            data = np.frombuffer(content, np.uint8)
            packet = kinds[name](header, height, width, k, time_base, encoding, False, data)
            bag.write(connection, k, store.serialize_cdr(packet, name))
