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
from polarnet.recordings.formats.prophesee import evt_decoder
from polarnet.recordings.source import Block, Choices, Counts, RecordingError, Source, chosen_part
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
        topic = chosen_part(path, choices.part, topics, "topic of events")
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
            if strange := [
                name
                for name in DEFINITIONS
                if bag.typestore.fielddefs.get(name, store.fielddefs[name]) != store.fielddefs[name]
            ]:
                raise RecordingError(f"{path.name}: expected {strange[0]} with the fields {DEFINITIONS[strange[0]]!r}")
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
    encoding, decode = "", None
    for packet in packets:
        if decode is None and packet.encoding in PACKETS:
            encoding, decode = packet.encoding, PACKETS[packet.encoding]()
        if decode is None or packet.encoding != encoding:
            raise RecordingError(
                f"{path.name}: expected packets of one encoding of {', '.join(PACKETS)}, got {packet.encoding!r}"
            )
        yield decode(packet, counts)


def _evt(version: str, word: str) -> Callable[[], Callable[[Any, Counts], Block]]:
    """A maker of decoders of Prophesee's words, whose time runs on from packet to packet."""

    def make() -> Callable[[Any, Counts], Block]:
        decode = evt_decoder(version)
        return lambda packet, counts: decode(_words(packet, word), counts)

    return make


def _mono(packet: Any, counts: Counts) -> Block:
    """Words of 64 bits: nanoseconds since the packet's time base, x, y, polarity."""
    words = _words(packet, "u8")
    t = (packet.time_base + (words & np.uint64(0xFFFFFFFF)).astype(np.int64)) // 1000
    return Block(t, words >> 32 & 0xFFFF, words >> 48 & 0x7FFF, words >> 63)


def _libcaer(packet: Any, counts: Counts) -> Block:
    """Polarity events of libcaer: y and x in the bits of 32, then 31 bits of microseconds since the time base in ns."""
    data, low = _words(packet, "u4").reshape(-1, 2).T
    wraps = np.cumsum(np.diff(low.astype(np.int64), prepend=low[:1]) < 0)
    return Block(packet.time_base // 1000 + low + (wraps << 31), data >> 17 & 0x7FFF, data >> 2 & 0x7FFF, data >> 1 & 1)


def _libcaer_compressed(packet: Any, counts: Counts) -> Block:
    """Words of 16 bits by their upper 4: 0 and 1 microseconds since the base, 2 x, 3 y, 4 base y, 5 a mask of rows."""
    words = _words(packet, "u2").astype(np.int64)
    kind, value, place = words >> 12, words & 0xFFF, np.arange(len(words))

    def latest(code: int) -> np.ndarray:
        """The place of the latest word of a kind; -1 before the first."""
        return np.maximum.accumulate(np.where(kind == code, place, -1))

    def valued(code: int) -> np.ndarray:
        return np.where(latest(code) < 0, 0, value[latest(code)])

    t, x, base = packet.time_base + (valued(0) << 12 | valued(1)), valued(2) & 0x7FF, valued(4)
    masks = np.cumsum(kind == 5)
    row = (base & 0x7FF) + 8 * (masks - 1 - np.where(latest(4) < 0, 0, masks[latest(4)]))
    at, bit = np.nonzero((kind == 5)[:, None] & (value[:, None] >> np.arange(8) & 1 == 1))
    one = np.flatnonzero(kind == 3)
    order = np.argsort(np.concatenate([one, at]), kind="stable")
    where = np.concatenate([one, at])[order]
    y, p = (
        np.concatenate([value[one] & 0x7FF, row[at] + bit])[order],
        np.concatenate([value[one] >> 11, base[at] >> 11]),
    )
    return Block(t[where], x[where], y, p[order])


def _words(packet: Any, kind: str) -> np.ndarray:
    content = np.asarray(packet.events)
    size = np.dtype(kind).itemsize
    return content[: len(content) // size * size].view(f"{'>' if packet.is_bigendian else '<'}{kind}")


PACKETS: dict[str, Callable[[], Callable[[Any, Counts], Block]]] = {
    "evt3": _evt("3", "u2"),
    "evt2": _evt("2", "u4"),
    "mono": lambda: _mono,
    "libcaer": lambda: _libcaer,
    "libcaer_cmp": lambda: _libcaer_compressed,
}
"""Makers of decoders of event_camera_msgs' encodings; a decoder takes consecutive packets."""
