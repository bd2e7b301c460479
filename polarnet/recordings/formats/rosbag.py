"""Bags of ROS 1 (.bag) and ROS 2 (a folder with metadata.yaml), read by the package rosbags.

Events are messages EventArray of dvs_msgs or prophesee_event_msgs: height, width and events of x, y, ts, polarity.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polarnet.recordings.formats.isolated import IsolatedLibrary
from polarnet.recordings.source import Block, Choices, RecordingError, Source, sensor_size

MAGIC = b"#ROSBAG V"

_library = IsolatedLibrary(
    "rosbags", "rosbags", "rosbag", Path(__file__).with_name("rosbag_tasks.py"), "the bag is damaged"
)


def matches(path: Path, head: bytes) -> bool:
    """Whether it is a bag of ROS 1, or the folder of a bag of ROS 2."""
    return (path / "metadata.yaml").exists() if path.is_dir() else head.startswith(MAGIC)


def open_rosbag(path: Path, choices: Choices) -> Source:
    """Open the events of a bag with one topic of them, or of the topic that `part` names."""
    if path.is_file() and path.suffix != ".bag":
        raise RecordingError(f"{path.name}: expected a name that ends in .bag, as the package rosbags does; rename it")
    topics, others = _library.ask(path, "topics")
    if choices.part not in topics and (choices.part is not None or len(topics) != 1):
        raise RecordingError(
            f"{path.name}: expected one topic of EventArray (dvs_msgs or prophesee_event_msgs), or --part TOPIC, got "
            f"{', '.join(topics) or f'only {others}'}"
        )
    topic = choices.part or topics[0]
    height, width = sensor_size(path, choices, *_library.ask(path, "size", topic))

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        for table in _library.blocks(path, topic):
            yield Block(*np.ascontiguousarray(table.T))

    return Source(height, width, blocks)
