"""Bags of ROS 1 (.bag) and ROS 2 (a folder with metadata.yaml, a .mcap or a .db3), read by the package rosbags.

Events are messages of two kinds. An EventArray (dvs_msgs, prophesee_event_msgs) lists them; its bytes are viewed as
records here. An EventPacket (event_camera_msgs) has them in one of the encodings of `PACKETS`, as the drivers of
Metavision and libcaer write them.
"""

import contextlib
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from polarnet.recordings.formats.isolated_worker import gathered
from polarnet.recordings.formats.prophesee import EVT_START, evt_block
from polarnet.recordings.source import Block, Choices, Counts, RecordingError, Source
from polarnet.terminal.installation import installation

SUFFIXES = {b"#ROSBAG V": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3": ".db3"}
"""Names that rosbags expects, by the first bytes."""
EVENTS, ARRAYS = (tuple(f"{p}/msg/{m}" for p in ("dvs_msgs", "prophesee_event_msgs")) for m in ("Event", "EventArray"))
PACKET = "event_camera_msgs/msg/EventPacket"
HEADER = "std_msgs/Header header\nuint32 height\nuint32 width\n"
DEFINITIONS = {
    **dict.fromkeys(EVENTS, "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity"),
    **dict.fromkeys(ARRAYS, f"{HEADER}Event[] events"),
    PACKET: f"{HEADER}uint64 seq\nuint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events",
}
"""Messages, which bags of ROS 2 may lack, and whose layout is the only one that is read."""


def matches(path: Path, head: bytes) -> bool:
    """Whether it is a bag of ROS 1, or a file or the folder of a bag of ROS 2."""
    return (path / "metadata.yaml").exists() if path.is_dir() else head.startswith(tuple(SUFFIXES))


def open_rosbag(path: Path, choices: Choices) -> Source:
    """Open the events of a bag with one topic of them, or of the topic that `part` names."""
    if path.is_file() and path.suffix not in SUFFIXES.values():
        raise RecordingError(
            f"{path.name}: expected a name that ends in .bag, .mcap or .db3, as rosbags does; rename it"
        )
    with _opened(path) as bag:
        topics = sorted({one.topic for one in bag.connections if one.msgtype in (*ARRAYS, PACKET)})
        if not topics:
            others = ", ".join(dict.fromkeys(f"{one.topic} ({one.msgtype})" for one in bag.connections))
            raise RecordingError(
                f"{path.name}: expected a topic of EventArray (dvs_msgs or prophesee_event_msgs) or EventPacket "
                f"(event_camera_msgs), got only {others[:300]}"
            )
        topic = choices.part_of(path.name, topics, "topic of events")
        first = next(_messages(bag, topic, Counts()), None)
    height, width = (None, None) if first is None else first[:2]

    def blocks(counts: Counts) -> Iterator[Block]:
        with _opened(path) as bag:
            messages = _messages(bag, topic, counts)
            if first is not None and isinstance(first[2], np.ndarray):
                for table in gathered(events for _, _, events in messages):
                    yield Block(_microseconds(table), table["x"], table["y"], table["p"])
            else:
                yield from _packet_blocks(path, (packet for _, _, packet in messages), counts)

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
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    try:
        with AnyReader([path], default_typestore=store) as bag:
            for name, text in DEFINITIONS.items():
                if bag.typestore.fielddefs.get(name, store.fielddefs[name]) != store.fielddefs[name]:
                    raise RecordingError(f"{path.name}: expected {name} with the fields {text!r}")
            yield bag
    except RecordingError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"[:500]
        raise RecordingError(f"{path.name}: rosbags cannot read it: {reason}; the bag is damaged") from error


def _messages(bag: Any, topic: str, counts: Counts) -> Iterator[tuple[int, int, Any]]:
    """Height, width, and the records of an EventArray or the whole EventPacket, of each message."""
    connections = [one for one in bag.connections if one.topic == topic]
    total = sum(one.msgcount for one in connections)
    for number, (connection, _, data) in enumerate(bag.messages(connections)):
        counts.share_read = min(1.0, number / max(1, total))
        if connection.msgtype in ARRAYS:
            yield _array_of(data, cdr=bag.is2)
        else:
            packet = bag.deserialize(data, connection.msgtype)
            yield packet.height, packet.width, packet


def _array_of(data: bytes, *, cdr: bool) -> tuple[int, int, np.ndarray]:
    """Height, width and records of a serialized EventArray: 13 bytes each in ROS 1, 16 in ROS 2 (CDR).

    CDR aligns the numbers, and so the fields of every record but the first, which begins 2 bytes later.
    """
    order = ">" if cdr and data[1] == 0 else "<"
    (name,) = struct.unpack_from(f"{order}I", data, 12)
    start = 16 + (-(-name // 4) * 4 if cdr else name)
    height, width, count = struct.unpack_from(f"{order}3I", data, start)
    start += 12
    names, kinds = ["x", "y", "s", "ns", "p"], [f"{order}u2", f"{order}u2", f"{order}u4", f"{order}u4", "u1"]
    if not cdr:
        record = np.dtype([*zip(names, kinds, strict=True)])
        return height, width, np.frombuffer(data, record, count, start)
    record = np.dtype({"names": names, "formats": kinds, "offsets": [0, 2, 6, 10, 14], "itemsize": 15})
    events = np.ndarray(count, record, data, start - 2, 16).copy()
    if count:
        events["x"][0], events["y"][0] = struct.unpack_from(f"{order}2H", data, start)
    return height, width, events


def _microseconds(events: np.ndarray) -> np.ndarray:
    return events["s"].astype(np.int64) * 1_000_000 + events["ns"] // 1000


def _packet_blocks(path: Path, packets: Iterator[Any], counts: Counts) -> Iterator[Block]:
    """Events of consecutive packets of one encoding."""
    encoding, state = "", np.array(EVT_START)
    for packet in packets:
        encoding = encoding or packet.encoding
        if encoding not in PACKETS or packet.encoding != encoding:
            raise RecordingError(
                f"{path.name}: expected packets of one encoding of {', '.join(PACKETS)}, got {packet.encoding!r}"
            )
        word, decode = PACKETS[encoding]
        content, kind = np.asarray(packet.events), np.dtype(f"{'>' if packet.is_bigendian else '<'}{word}")
        words = content[: len(content) // kind.itemsize * kind.itemsize].view(kind)
        yield decode(words.astype(word, copy=False), packet.time_base, state, counts)


def _mono(words: np.ndarray, base: int, state: np.ndarray, counts: Counts) -> Block:
    """Words of 64 bits: nanoseconds since the packet's time base, x, y, polarity."""
    t = (base + (words & np.uint64(0xFFFFFFFF)).astype(np.int64)) // 1000
    return Block(t, words >> 32 & 0xFFFF, words >> 48 & 0x7FFF, words >> 63)


def _libcaer(words: np.ndarray, base: int, state: np.ndarray, counts: Counts) -> Block:
    """Polarity events of libcaer: y and x in the bits of 32, then 31 bits of microseconds since the time base in ns."""
    data, low = words.reshape(-1, 2).T
    wraps = np.cumsum(np.diff(low.astype(np.int64), prepend=low[:1]) < 0)
    return Block(base // 1000 + low + (wraps << 31), data >> 17 & 0x7FFF, data >> 2 & 0x7FFF, data >> 1 & 1)


def _libcaer_compressed(words: np.ndarray, base: int, state: np.ndarray, counts: Counts) -> Block:
    """Compressed events of libcaer, in microseconds since the packet's time base."""
    t, y, x, p = evt_block("libcaer_cmp", words, np.zeros_like(state), counts)
    return Block(base + t, x, y, p)


PACKETS: dict[str, tuple[str, Callable[[np.ndarray, int, np.ndarray, Counts], Block]]] = {
    "evt3": ("u2", lambda words, base, *passed_on: evt_block("3", words, *passed_on)),
    "evt2": ("u4", lambda words, base, *passed_on: evt_block("2", words, *passed_on)),
    "mono": ("u8", _mono),
    "libcaer": ("u4", _libcaer),
    "libcaer_cmp": ("u2", _libcaer_compressed),
}
"""Word and decoder of event_camera_msgs' encodings; a decoder takes words, time base and state of a packet."""
