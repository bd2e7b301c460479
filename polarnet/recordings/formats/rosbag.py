"""Bags of ROS 1 (.bag) and ROS 2 (a folder with metadata.yaml), read by the package rosbags.

Events are messages EventArray of dvs_msgs or prophesee_event_msgs: height, width and events of x, y, ts, polarity.
"""

import contextlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from polarnet.recordings.formats.isolated_worker import gathered
from polarnet.recordings.source import Block, Choices, RecordingError, Source, sensor_size
from polarnet.terminal.installation import installation

MAGIC = b"#ROSBAG V"
PACKAGES = ("dvs_msgs", "prophesee_event_msgs")
EVENT_ARRAYS = tuple(f"{package}/msg/EventArray" for package in PACKAGES)
DEFINITIONS = {
    "Event": "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity",
    "EventArray": "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events",
}
"""Messages of both packages, which bags of ROS 2 may lack."""


def matches(path: Path, head: bytes) -> bool:
    """Whether it is a bag of ROS 1, or the folder of a bag of ROS 2."""
    return (path / "metadata.yaml").exists() if path.is_dir() else head.startswith(MAGIC)


def open_rosbag(path: Path, choices: Choices) -> Source:
    """Open the events of a bag with one topic of them, or of the topic that `part` names."""
    if path.is_file() and path.suffix != ".bag":
        raise RecordingError(f"{path.name}: expected a name that ends in .bag, as the package rosbags does; rename it")
    with _opened(path) as bag:
        topics = sorted({one.topic for one in bag.connections if one.msgtype in EVENT_ARRAYS})
        others = ", ".join({f"{one.topic} ({one.msgtype})": 1 for one in bag.connections if one.topic not in topics})
        if choices.part not in topics and (choices.part is not None or len(topics) != 1):
            raise RecordingError(
                f"{path.name}: expected one topic of EventArray (dvs_msgs or prophesee_event_msgs), or --part TOPIC, "
                f"got {', '.join(topics) or f'only {others[:300]}'}"
            )
        topic = choices.part or topics[0]
        first = next(_messages(bag, topic), None)
    stated = (None, None) if first is None else (int(first.height), int(first.width))
    height, width = sensor_size(path, choices, *stated)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        with _opened(path) as bag:
            for table in gathered(map(_rows, _messages(bag, topic))):
                yield Block(*np.ascontiguousarray(table.T))

    return Source(height, width, blocks)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A reader of the bag; RecordingError with the reason where it is damaged, RuntimeError without the package."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise RuntimeError(f"{path.name}: this format needs rosbags: {installation('recordings')}") from None
    store = get_typestore(Stores.LATEST)
    for package in PACKAGES:
        for name, text in DEFINITIONS.items():
            store.register(get_types_from_msg(text, f"{package}/msg/{name}"))
    try:
        with AnyReader([path], default_typestore=store) as bag:
            yield bag
    except RecordingError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"[:500]
        raise RecordingError(f"{path.name}: rosbags cannot read it: {reason}; the bag is damaged") from error


def _messages(bag: Any, topic: str) -> Iterator[Any]:
    for connection, _, data in bag.messages([one for one in bag.connections if one.topic == topic]):
        yield bag.deserialize(data, connection.msgtype)


def _rows(message: Any) -> np.ndarray:
    """Rows t (microseconds), x, y, p of a message."""
    rows = [(e.ts.sec * 10**6 + e.ts.nanosec // 1000, e.x, e.y, e.polarity) for e in message.events]
    return np.array(rows, np.int64).reshape(-1, 4)
