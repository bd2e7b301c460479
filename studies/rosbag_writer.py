"""Write bags of ROS 1 and ROS 2 with events, for tests of the reader; needs the package rosbags."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

EVENT = "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity"
EVENT_ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events"
ROS1_TIME = "time"


def write_bag(
    path: Path,
    rows: Sequence[tuple[int, int, int, int]],
    height: int,
    width: int,
    topics: Sequence[str] = ("/dvs/events",),
    form: str = "ros1",
    package: str = "dvs_msgs",
) -> None:
    """Write rows t (microseconds), x, y, p to each topic: a message with all but the last, and one with the last."""
    from rosbags.rosbag1 import Writer as Writer1
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
    with Writer1(path) if old else Writer2(path, version=9) as bag:
        for topic in topics:
            connection = bag.add_connection(topic, array, typestore=store)
            for k, some in enumerate((rows[:-1], rows[-1:])):
                bag.write(connection, k, serialize(message(some), array))
