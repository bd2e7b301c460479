"""Write recordings of every format that polarnet reads, for measurements and for tests of the readers."""

import itertools
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64, UInt8

from polarnet.events.stream import Events, places_of, slice_count
from polarnet.networks.e2p.network import MOSAIC
from polarnet.recordings.formats import aedat, celex5
from polarnet.recordings.formats.hdf5 import LAYOUTS
from polarnet.recordings.formats.lines import lines_of
from polarnet.recordings.writers import h5py_module, write_hdf5, write_text
from studies.celex5_writer import write_celex5_bin

PACKET_EVENTS = 10_000
TEXT_LINES = 1_000_000  # formatted at a time
EXPOSURE_US, RESET_LEVEL = 8000, 900  # of frames in AEDAT-2
WHITE = 255  # of frames and maps in E2P's files
NO_TIMES, NO_FRAMES = np.empty(0, np.int64), np.empty((0, 1, 1), np.uint8)
ARRAY, PACKET = "dvs_msgs/msg/EventArray", "event_camera_msgs/msg/EventPacket"
DEFINITIONS = {
    "Event": "uint16 x\nuint16 y\n{time} ts\nbool polarity",
    "EventArray": "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events",
    "EventPacket": "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
    "string encoding\nbool is_bigendian\nuint8[] events",
}

Writer = Callable[[Path, Events], object]


def columns_of(events: Events) -> list[np.ndarray]:
    """Columns t, x, y, p of 64 bits; p is 1 or 0."""
    return [column.long().numpy() for column in (events.t, events.x, events.y, events.p > 0)]


def parts_of(events: Events, size: int) -> Iterator[list[np.ndarray]]:
    """The columns in parts of `size` events."""
    for start in range(0, len(events), size):
        yield columns_of(slice_count(events, start, start + size))


def binary(header: str, content_of: Callable[..., Any], size: int = TEXT_LINES) -> Writer:
    """A writer of a header, with {height} and {width}, and of the bytes of the columns, `size` events at a time."""

    def write(path: Path, events: Events) -> None:
        with path.open("wb") as file:
            file.write(header.format(height=events.height, width=events.width).encode("latin-1"))
            file.writelines(itertools.starmap(content_of, parts_of(events, size)))

    return write


def separated(*columns: np.ndarray, by: str = ",") -> bytes:
    """Lines of whole numbers."""
    return lines_of(np.stack(columns, axis=1), by)


def evt2(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Words of 32 bits."""
    words = np.stack([8 << 28 | t >> 6, p << 28 | (t & 63) << 22 | x << 11 | y], axis=1)
    return words[np.stack([np.diff(t >> 6, prepend=-1) != 0, t >= 0], axis=1)].astype("<u4")


def evt21(*columns: np.ndarray) -> np.ndarray:
    """Words of 64 bits, whose lower half says which of 32 pixels from x on have the event: the first."""
    return evt2(*columns).astype("<u8") << np.uint64(32) | np.uint64(1)


def evt3(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> bytes:
    """Words of 16 bits."""
    words = np.stack([0x8000 | t >> 12 & 0xFFF, 0x6000 | t & 0xFFF, y, 0x2000 | p << 11 | x], axis=1)
    new = np.stack([np.diff(t >> 12, prepend=-1) != 0, np.diff(t, prepend=-1) != 0], axis=1)
    return words[np.hstack([new, np.ones_like(new)])].astype("<u2").tobytes()


def aedat3_packet(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> bytes:
    """A packet of AEDAT 3.1."""
    entries = np.stack([x << 17 | y << 2 | p << 1 | 1, t], axis=1).astype("<u4")
    return aedat.PACKET.pack(1, 1, 8, 4, 0, *[len(t)] * 3) + entries.tobytes()


def write_aedat2(path: Path, events: Events, t_us: Int64[np.ndarray, " n"], frames: UInt8[np.ndarray, "n h w"]) -> None:
    """As jAER writes a DAVIS: columns of events count from the right, those of samples from the left, rows from below.

    A frame has a sample of each pixel after its reset and one after its exposure, whose middle is at `t_us`.
    """
    t, x, y, p = columns_of(events)
    entries = [np.stack([events.height - 1 - y << 22 | events.width - 1 - x << 12 | p << 11, t], axis=1)]
    y, x = np.mgrid[: events.height, : events.width]
    place = (1 << 31 | (events.height - 1 - y) << 22 | x << 12).ravel()
    for middle, frame in zip(t_us, frames, strict=True):
        signal = place | 1 << 10 | (RESET_LEVEL - frame.ravel().astype(np.int64))
        for sample, time in ((place | RESET_LEVEL, middle - EXPOSURE_US // 2), (signal, middle + EXPOSURE_US // 2)):
            entries.append(np.stack([sample, np.full(len(sample), time)], axis=1))
    table = np.concatenate(entries)
    header = (
        f"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.Davis{events.width}blue\r\n#End Of ASCII Header\r\n"
    )
    path.write_bytes(header.encode() + table[np.argsort(table[:, 1], kind="stable")].astype(">u4").tobytes())


def write_e2p(
    path: Path,
    events: Events,
    t_us: Int64[np.ndarray, " n"],
    frames: UInt8[np.ndarray, "n h w"] | None,
    maps: tuple[Float[np.ndarray, "n h2 w2"], Float[np.ndarray, "n h2 w2"], Float[np.ndarray, "n h2 w2"]] | None,
) -> None:
    """Write the events of the whole mosaic, frames of the same size at `t_us`, and maps of S0 (1: white), DoLP, AoLP.

    Maps are stored in 255 steps, rounded to the nearest; AoLP from -90 degrees on.
    """
    table = np.stack([events.t.numpy(), events.x.numpy(), events.y.numpy(), events.p.numpy() > 0], axis=1)
    with h5py_module().File(path, "w") as file:
        file["events"] = table.astype(np.uint32)
        file["frame_ts"] = t_us.astype(np.uint32)
        file["frame_idx"] = np.searchsorted(events.t.numpy(), t_us).astype(np.uint64)
        if frames is not None:
            file["frame"] = frames
        if maps is not None:
            s0, dolp, aolp = maps
            code = np.remainder(aolp / np.pi + 0.5, 1.0)
            for name, values in (("intensity", s0), ("dolp", dolp), ("aolp", code)):
                file[name] = np.rint(WHITE * values).astype(np.uint8)
        file.attrs["sensor_resolution"] = events.width, events.height


def mosaicked(planes: np.ndarray) -> np.ndarray:
    """One mosaic 90 45 / 135 0 of twice the size, from n x 4 x h x w planes at 0, 45, 90 and 135 degrees."""
    n, _, height, width = planes.shape
    mosaic = np.empty((n, 2 * height, 2 * width), planes.dtype)
    for plane, (row, column) in zip(planes.swapaxes(0, 1), places_of(MOSAIC), strict=True):
        mosaic[:, row::2, column::2] = plane
    return mosaic


def table_writer(name: str) -> Writer:
    """A writer of HDF5 in a layout, with the sensor's size as attributes."""
    layout, kinds = LAYOUTS[name], ("f8" if LAYOUTS[name].seconds else "i8", "u2", "u2", "u1")

    def write(path: Path, events: Events) -> None:
        import h5py

        t, x, y, p = columns_of(events)
        tables: dict[str, dict[Any, np.ndarray]] = {}
        values = t * 1e-6 if layout.seconds else t, x, y, p
        for (table, field), column, kind in zip(layout.of(layout.parts[0]), values, kinds, strict=True):
            tables.setdefault(table, {})[field] = column if isinstance(field, int) else column.astype(kind)
        with h5py.File(path, "w") as file:
            file.attrs["height"], file.attrs["width"] = events.height, events.width
            for table, fields in tables.items():
                if 0 in fields:
                    content = np.stack([fields[k] for k in range(len(fields))], axis=1)
                else:
                    kinds_of = [(field, column.dtype) for field, column in fields.items()]
                    content = fields[None] if None in fields else np.rec.fromarrays([*fields.values()], dtype=kinds_of)
                file.create_dataset(table, data=content, chunks=True)

    return write


def with_faery(path: Path, events: Events) -> None:
    """AEDAT4 or Event Stream, by the suffix."""
    import faery

    rows = np.empty(len(events), faery.EVENTS_DTYPE)
    for name, column in zip(("t", "x", "y", "on"), columns_of(events), strict=True):
        rows[name] = column
    faery.events_stream_from_array(rows, (events.width, events.height)).to_file(path)


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


def messages(content_of: Callable[..., bytes], kind: str, plugin: str | None) -> Writer:
    """A writer of a bag with a message for every `PACKET_EVENTS` events."""

    def write(path: Path, events: Events) -> None:
        contents = itertools.starmap(content_of, parts_of(events, PACKET_EVENTS))
        write_bag(path, events.height, events.width, contents, kind=kind, plugin=plugin)

    return write


PROPHESEE = "% evt {v}\n% format EVT{v};endianness=little;height={{height}};width={{width}}\n% end\n"
DAT = "% Version 2\n% Height {height}\n% Width {width}\n\x0c\x08"
AEDAT3 = "#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DAVIS{width}\r\n#!END-HEADER\r\n"
FILES: dict[str, tuple[str, Writer]] = {
    **{name: (".h5", table_writer(name)) for name in LAYOUTS},
    "dsec of polarnet": (".h5", write_hdf5),
    "rosbag": (".bag", messages(array_bytes, ARRAY, None)),
    "rosbag of EventPacket": ("", messages(lambda *columns: packet_bytes("evt3", 0, evt3(*columns)), PACKET, "MCAP")),
    "aedat4": (".aedat4", with_faery),
    "aedat3": (".aedat", binary(AEDAT3, aedat3_packet, PACKET_EVENTS)),
    "aedat2": (".aedat", lambda path, events: write_aedat2(path, events, NO_TIMES, NO_FRAMES)),
    "event_stream": (".es", with_faery),
    "evt": (".raw", binary(PROPHESEE.format(v="3.0"), evt3)),
    "evt 2": (".raw", binary(PROPHESEE.format(v="2.0"), evt2)),
    "evt 2.1": (".raw", binary(PROPHESEE.format(v="2.1"), evt21)),
    "dat": (".dat", binary(DAT, lambda t, x, y, p: np.stack([t, x | y << 14 | p << 28], axis=1).astype("<u4"))),
    "text": (".txt", write_text),
    "text of microseconds": (".txt", binary("{width} {height}\n", lambda *columns: separated(*columns, by=" "))),
    "text, CSV of Prophesee": (
        ".csv",
        binary("%geometry:{width},{height}\n", lambda t, x, y, p: separated(x, y, p, t)),
    ),
    "celex5_csv": (
        ".csv",
        binary("", lambda t, x, y, p: separated(y, x, np.full_like(t, celex5.WHITE // 2), 2 * p - 1, t)),
    ),
    "celex5_bin": (".bin", write_celex5_bin),
}
"""Suffix and writer of each format, and of further kinds of files whose first word is the format."""
