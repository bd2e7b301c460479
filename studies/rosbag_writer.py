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

    `form` is ros1 (then `package` is dvs_msgs) or ros2; `plugin` the storage of ROS 2, sqlite3 or mcap.
    """
    parts = rows[:-1], rows[-1:]
    if form == "ros1":
        contents = [array_bytes(*np.array(part, int).reshape(-1, 4).T) for part in parts]
        write_arrays(path, height, width, contents, topics)
        return
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, array = get_typestore(Stores.ROS2_HUMBLE), f"{package}/msg/EventArray"
    for name, text in (("Event", EVENT), ("EventArray", EVENT_ARRAY)):
        store.register(get_types_from_msg(text, f"{package}/msg/{name}"))
    event, time = store.types[f"{package}/msg/Event"], store.types["builtin_interfaces/msg/Time"]
    header = store.types["std_msgs/msg/Header"](stamp=time(sec=0, nanosec=0), frame_id="")

    def message(part: Sequence[tuple[int, int, int, int]]) -> Any:
        events = [
            event(x=x, y=y, ts=time(sec=t // 10**6, nanosec=t % 10**6 * 1000), polarity=p > 0) for t, x, y, p in part
        ]
        return store.types[array](header=header, height=height, width=width, events=events)

    with Writer(path, version=9, storage_plugin=StoragePlugin[plugin.upper()]) as bag:
        for topic in topics:
            connection = bag.add_connection(topic, array, typestore=store)
            for k, part in enumerate(parts):
                bag.write(connection, k, store.serialize_cdr(message(part), array))


def array_bytes(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> bytes:
    """The events of an EventArray as ROS 1 serializes them: their number, then 13 bytes each."""
    records = np.empty(len(t), [("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
    for name, values in zip(("x", "y", "s", "ns", "p"), (x, y, t // 10**6, t % 10**6 * 1000, p > 0), strict=True):
        records[name] = values
    return struct.pack("<I", len(t)) + records.tobytes()


def write_arrays(
    path: Path, height: int, width: int, contents: Iterable[bytes], topics: Sequence[str] = ("/dvs/events",)
) -> None:
    """Write a ROS 1 bag with an EventArray of dvs_msgs in each topic for each of `array_bytes`."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in (("Event", EVENT), ("EventArray", EVENT_ARRAY)):
        store.register(get_types_from_msg(text.replace("builtin_interfaces/Time", "time"), f"dvs_msgs/msg/{name}"))
    with Writer(path) as bag:
        connections = [bag.add_connection(topic, "dvs_msgs/msg/EventArray", typestore=store) for topic in topics]
        for k, content in enumerate(contents):
            for connection in connections:
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
