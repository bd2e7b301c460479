"""Tasks of the rosbags process; see `isolated_worker`."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

EVENT_ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
EVENT = "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity"
EVENT_ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events"


def opened(path: str) -> AnyReader:
    """A reader of the bag; bags of ROS 2 may lack the definitions of their messages."""
    store = get_typestore(Stores.LATEST)
    for package in ("dvs_msgs", "prophesee_event_msgs"):
        for name, text in (("Event", EVENT), ("EventArray", EVENT_ARRAY)):
            store.register(get_types_from_msg(text, f"{package}/msg/{name}"))
    return AnyReader([Path(path)], default_typestore=store)


def topics(path: str) -> tuple[list[str], str]:
    """Topics of events, and a list of the others with their types."""
    with opened(path) as bag:
        chosen = sorted({one.topic for one in bag.connections if one.msgtype in EVENT_ARRAYS})
        others = sorted({f"{one.topic} ({one.msgtype})" for one in bag.connections if one.topic not in chosen})
        return chosen, ", ".join(others)[:300]


def messages(path: str, topic: str) -> Iterator[Any]:
    """The messages of a topic."""
    with opened(path) as bag:
        for connection, _, data in bag.messages([one for one in bag.connections if one.topic == topic]):
            yield bag.deserialize(data, connection.msgtype)


def size(path: str, topic: str) -> tuple[int | None, int | None]:
    """Height and width of the sensor in the first message; None without messages."""
    first = next(messages(path, topic), None)
    return (None, None) if first is None else (int(first.height), int(first.width))


def pieces(path: str, topic: str) -> Iterator[np.ndarray]:
    """Rows t (microseconds), x, y, p of each message."""
    for message in messages(path, topic):
        rows = [(e.ts.sec * 10**6 + e.ts.nanosec // 1000, e.x, e.y, e.polarity) for e in message.events]
        yield np.array(rows, np.int64).reshape(-1, 4)


TASKS: dict[str, Callable[..., Any]] = {"topics": topics, "size": size, "pieces": pieces}
