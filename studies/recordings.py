"""Speed and memory of recordings: python -m studies.recordings [--write] [--sections NAME ...] [--formats NAME ...]

Sections of docs/results/recordings.json, each measured in processes of their own:

- `readers`: M events per CPU second of every reader and of `polarnet inspect`, on 10 M random events, 1 M a second, of
  a 1280 x 720 sensor (10 k events a packet or message). The CPU time is that of the process and its children, the
  shortest of three runs, with the file in the disk cache. Writers: the same from memory.
- `bytes`: memory of `read_recording` for each event more, between 8 and 32 M events.
- `memory`: peak of `inspect`, `convert` and `recover --method highpass` on 2, 8 and 32 M events of a 346 x 260 sensor.
- `cases`: tests of the reference cases, with POLARNET_SHARED.
"""

import argparse
import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import psutil
import torch

from polarnet.cli import main as polarnet
from polarnet.events.stream import Events
from polarnet.recordings.formats.aedat3 import PACKET
from polarnet.recordings.formats.hdf5 import LAYOUTS
from polarnet.recordings.formats.lines import lines_of
from polarnet.recordings.recording import open_recording, read_recording
from polarnet.recordings.writers import FORMS, write_text
from polarnet.storage.events import EventStore
from studies.celex5_writer import write_celex5_bin, write_celex5_csv
from studies.rosbag_writer import array_bytes, write_arrays, write_packets
from studies.study import ROOT, arguments_of, command_line, in_own_process, machine_record, read_results, write_section

COUNT, SMALL = 10_000_000, 20_000  # events; the small file compiles every kernel
PART = 1_000_000  # events that are made at a time, and microseconds that they take
PACKET_EVENTS = 10_000
REPEATS = 3
HEIGHT, WIDTH = 720, 1280
CELEX5 = 800, 1280
MEMORY_SIZES = (2_000_000, 8_000_000, 32_000_000)
MEMORY_SENSOR = 260, 346
MEMORY_FORMS = ("evt3", "hdf5", "text")
COMMANDS: dict[str, list[str]] = {
    "inspect": ["--out", "OUT"],
    "convert": ["OUT"],
    "recover": ["--method", "highpass", "--mosaic", "90 45 / 135 0", "--write", "zarr", "--out", "OUT"],
}
MIB = 2**20
SECTIONS = ("readers", "memory", "cases")


def parts(count: int, height: int = HEIGHT, width: int = WIDTH) -> Iterator[Events]:
    """The same random events again and again, later each time."""
    generator = torch.Generator().manual_seed(0)
    size = min(count, PART)
    t = torch.randint(PART, (size,), generator=generator).sort().values
    x, y, p = (torch.randint(limit, (size,), generator=generator) for limit in (width, height, 2))
    for start in range(0, count, PART):
        yield Events(t + start, x.short(), y.short(), (2 * p - 1).to(torch.int8), height, width)


def columns_of(part: Events) -> list[np.ndarray]:
    """Columns t, x, y, p of 64 bits; p is 1 or 0."""
    return [
        part.t.numpy(),
        part.x.numpy().astype(np.int64),
        part.y.numpy().astype(np.int64),
        (part.p > 0).long().numpy(),
    ]


Parts = Iterable[Events]
Writer = Callable[[Path, Parts], object]


def binary(header: bytes, content_of: Callable[..., bytes]) -> Writer:
    """A writer of a header and of the bytes of columns t, x, y, p, a packet at a time."""

    def write(path: Path, some: Parts) -> None:
        with path.open("wb") as file:
            file.write(header)
            for part in some:
                file.write(content_of(*columns_of(part)))

    return write


def evt2(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Words of 32 bits."""
    words = np.stack([8 << 28 | t >> 6, p << 28 | (t & 63) << 22 | x << 11 | y], axis=1)
    return words[np.stack([np.diff(t >> 6, prepend=-1) != 0, t >= 0], axis=1)].astype("<u4")


def evt21(*columns: np.ndarray) -> bytes:
    """Words of 64 bits: a word of EVT2, and a mask of one pixel."""
    return (evt2(*columns).astype("<u8") << np.uint64(32) | np.uint64(1)).tobytes()


def evt3(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> bytes:
    """Words of 16 bits."""
    words = np.stack([0x8000 | t >> 12 & 0xFFF, 0x6000 | t & 0xFFF, y, 0x2000 | p << 11 | x], axis=1)
    new = np.stack([np.diff(t >> 12, prepend=-1) != 0, np.diff(t, prepend=-1) != 0], axis=1)
    return words[np.hstack([new, np.ones_like(new)])].astype("<u2").tobytes()


def aedat3_packets(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> bytes:
    """Packets of AEDAT 3.1."""
    entries = np.stack([x << 17 | y << 2 | p << 1 | 1, t], axis=1).astype("<u4")
    some = (entries[start : start + PACKET_EVENTS] for start in range(0, len(t), PACKET_EVENTS))
    return b"".join(PACKET.pack(1, 1, 8, 4, 0, len(one), len(one), len(one)) + one.tobytes() for one in some)


def table_writer(name: str) -> Writer:
    """A writer of HDF5 in a layout, with whole microseconds or seconds, and the sensor's size as attributes."""
    layout, kinds = LAYOUTS[name], ("f8" if LAYOUTS[name].seconds else "i8", "u2", "u2", "u1")

    def write(path: Path, some: Parts) -> None:
        import h5py

        t, x, y, p = map(np.concatenate, zip(*map(columns_of, some), strict=True))
        values = dict(zip("txyp", (t * 1e-6 if layout.seconds else t, x, y, p), strict=True))
        tables: dict[str, dict[Any, np.ndarray]] = {}
        for (table, field), column, kind in zip(layout.of(layout.parts[0]), values.values(), kinds, strict=True):
            tables.setdefault(table, {})[field] = column if isinstance(field, int) else column.astype(kind)
        with h5py.File(path, "w") as file:
            file.attrs["height"], file.attrs["width"] = HEIGHT, WIDTH
            for table, fields in tables.items():
                if isinstance(next(iter(fields)), str):
                    content = np.empty(len(t), [(field, column.dtype) for field, column in fields.items()])
                    for field, column in fields.items():
                        content[field] = column
                else:
                    content = fields[None] if None in fields else np.stack([fields[k] for k in range(4)], axis=1)
                file.create_dataset(table, data=content, chunks=True)

    return write


def with_faery(path: Path, some: Parts) -> None:
    """AEDAT4 or Event Stream, by the suffix."""
    import faery

    columns = list(map(np.concatenate, zip(*map(columns_of, some), strict=True)))
    rows = np.empty(len(columns[0]), faery.EVENTS_DTYPE)
    for name, column in zip(("t", "x", "y", "on"), columns, strict=True):
        rows[name] = column
    faery.events_stream_from_array(rows, (WIDTH, HEIGHT)).to_file(path)


def write_store(path: Path, some: Parts) -> None:
    """An event store whose four channels are the same."""
    store = EventStore.create(path, ["one"], HEIGHT, WIDTH, {})
    events = whole(some)
    store.write("one", [events] * 4, int(events.t[-1]))
    store.finish()


def whole(some: Parts) -> Events:
    """All events."""
    t, x, y, p = map(torch.cat, zip(*([part.t, part.x, part.y, part.p] for part in some), strict=True))
    return Events(t, x, y, p, HEIGHT, WIDTH)


def write_celex5(write: Callable[[Path, Events], object]) -> Writer:
    """A writer of a CeleX-5, from its 1280 x 800 pixels."""
    return lambda path, some: write(path, replace(whole(some), height=CELEX5[0], width=CELEX5[1]))


def messages(path: Path, some: Parts, content_of: Callable[..., Any], write: Callable[..., object]) -> None:
    """A bag with a message for every `PACKET_EVENTS` events."""
    columns = (columns_of(part) for part in some)
    cut = (
        [column[start : start + PACKET_EVENTS] for column in part]
        for part in columns
        for start in range(0, len(part[0]), PACKET_EVENTS)
    )
    write(path, HEIGHT, WIDTH, (content_of(*one) for one in cut))


PROPHESEE = b"% evt {v}\n% format EVT{v};endianness=little;height=720;width=1280\n% geometry 1280x720\n% end\n"
JAER = b"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.Davis346blue\r\n#End Of ASCII Header\r\n"
AEDAT3 = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DAVIS640\r\n#!END-HEADER\r\n"
FILES: dict[str, tuple[str, Writer]] = {
    "text: seconds": (".txt", lambda path, some: write_text(path, some, None)),
    "text: microseconds": (".txt", binary(b"", lambda *c: lines_of(np.stack(c, axis=1), " "))),
    "text: CSV of Prophesee": (".csv", binary(b"", lambda t, x, y, p: lines_of(np.stack([x, y, p, t], axis=1), ","))),
    **{f"{name}: HDF5": (".h5", table_writer(name)) for name in LAYOUTS},
    "dsec: HDF5 of polarnet": (".h5", lambda path, some: FORMS["hdf5"][1](path, some, None)),
    "evt: EVT2": (".raw", binary(PROPHESEE.replace(b"{v}", b"2.0"), lambda *c: evt2(*c).tobytes())),
    "evt: EVT2.1": (".raw", binary(PROPHESEE.replace(b"{v}", b"2.1"), evt21)),
    "evt: EVT3": (".raw", binary(PROPHESEE.replace(b"{v}", b"3.0"), evt3)),
    "dat": (
        ".dat",
        binary(
            b"% Version 2\n% Height 720\n% Width 1280\n\x0c\x08",
            lambda t, x, y, p: np.stack([t, x | y << 14 | p << 28], axis=1).astype("<u4").tobytes(),
        ),
    ),
    "aedat2": (
        ".aedat",
        binary(
            JAER,
            lambda t, x, y, p: np.stack([y % 260 << 22 | x % 346 << 12 | p << 11, t], axis=1).astype(">u4").tobytes(),
        ),
    ),
    "aedat3": (".aedat", binary(AEDAT3, lambda t, x, y, p: aedat3_packets(t, x % 640, y % 480, p))),
    "aedat4": (".aedat4", with_faery),
    "event_stream": (".es", with_faery),
    "rosbag: EventArray, ROS 1": (".bag", lambda path, some: messages(path, some, array_bytes, write_arrays)),
    "rosbag: EventPacket, EVT3": (
        "",
        lambda path, some: messages(path, some, lambda *c: ("evt3", 0, evt3(*c)), write_packets),
    ),
    "celex5_csv": (".csv", write_celex5(write_celex5_csv)),
    "celex5_bin": (".bin", write_celex5(write_celex5_bin)),
    "store": (".zarr", write_store),
}
"""Format and kind of a file, its suffix and a writer."""


def options_of(name: str) -> dict[str, Any]:
    """What a file of a kind does not state."""
    stated = not name.startswith("text") or name == "text: seconds"
    return {"height": None if stated else HEIGHT, "width": None if stated else WIDTH,
            "part": {"store": "0", "m3ed: HDF5": "left", "mvsec: HDF5": "left"}.get(name)}  # fmt: skip


def cpu_s() -> float:
    """CPU seconds of this process and its children."""
    own = psutil.Process()
    times = [one.cpu_times() for one in (own, *own.children(recursive=True))]
    return sum(one.user + one.system for one in times) + own.cpu_times().children_user


def shortest_cpu_s(run: Callable[[], object]) -> float:
    """CPU seconds of the fastest of three runs."""
    seconds = []
    for _ in range(REPEATS):
        start = cpu_s()
        run()
        seconds.append(cpu_s() - start)
    return min(seconds)


def speed_of_reader(name: str) -> dict[str, float]:
    """M events per CPU second of `open_recording` and of `polarnet inspect`."""
    suffix, write = FILES[name]
    with tempfile.TemporaryDirectory() as folder:
        large, small = Path(folder, f"large{suffix}"), Path(folder, f"small{suffix}")
        write(large, parts(COUNT))
        write(small, parts(SMALL))
        options = options_of(name)

        def read(path: Path) -> int:
            return sum(map(len, open_recording(path, **options)))

        def inspect(path: Path) -> None:
            given = [word for key, value in options.items() if value for word in (f"--{key}", str(value))]
            if polarnet(["inspect", str(path), *given, "--out", folder]):
                raise RuntimeError(f"{name}: polarnet inspect failed")

        read(small)
        inspect(small)
        count = read(large)
        if count < 0.99 * COUNT:
            raise RuntimeError(f"{name}: expected {COUNT} events, read {count}")
        seconds = {"read": shortest_cpu_s(lambda: read(large)), "inspect": shortest_cpu_s(lambda: inspect(large))}
    return {key: round(count / one / 1e6, 2) for key, one in seconds.items()}


def speed_of_writer(form: str) -> float:
    """M events per CPU second of a writer."""
    suffix, write = FORMS[form]
    events = whole(parts(COUNT))
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder, f"small{suffix}"), parts(SMALL), None)
        return round(COUNT / shortest_cpu_s(lambda: write(Path(folder, f"large{suffix}"), events, None)) / 1e6, 2)


def peak_mib() -> float:
    """Peak memory in MiB of this process and its children."""
    own = psutil.Process()
    marks = [Path(f"/proc/{process.pid}/status").read_text() for process in (own, *own.children(recursive=True))]
    return sum(int(line.split()[1]) for mark in marks for line in mark.splitlines() if line.startswith("VmHWM")) / 1024


def peak_of_command(command: str, path: str) -> float:
    """Peak memory in MiB of a command of polarnet on a file."""
    with tempfile.TemporaryDirectory() as folder:
        words = [word.replace("OUT", f"{folder}/out.h5") for word in COMMANDS[command]]
        if polarnet([command, path, *words]):
            raise RuntimeError(f"polarnet {command} {path} failed")
    return round(peak_mib(), 1)


def peak_of_array(path: str) -> float:
    """Peak memory in MiB of `read_recording`."""
    read_recording(path)
    return round(peak_mib(), 1)


def measure_readers(formats: Iterable[str], known: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Speed of these readers beside the known ones, and of every writer."""
    files, writers = known.get("files", {}), {}
    for name in formats:
        files[name] = in_own_process("studies.recordings", "--one", "reader", name)
        print(name, files[name], flush=True)
    for form in FORMS:
        writers[form] = in_own_process("studies.recordings", "--one", "writer", form)
        print(form, writers[form], flush=True)
    return {"files": files, "writers": writers}, {"readers_mev_per_cpu_s": {n: one["read"] for n, one in files.items()}}


def measure_memory(forms: Iterable[str], known: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Peak memory of the commands, and bytes an event of an array, beside the known ones of other formats."""
    rows, arrays = known.get("commands", {}), known.get("bytes_per_event", {})
    for form in forms:
        peaks: dict[int, dict[str, float]] = {}
        for size in MEMORY_SIZES:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, f"recording{FORMS[form][0]}")
                FORMS[form][1](path, parts(size, *MEMORY_SENSOR), None)
                peaks[size] = {
                    name: in_own_process("studies.recordings", "--one", name, path) for name in (*COMMANDS, "array")
                }
            print(form, size, peaks[size], flush=True)
        for name in COMMANDS:
            rows[f"{name}, {form}"] = {f"{size // 1_000_000}M": round(one[name]) for size, one in peaks.items()}
        few, many = MEMORY_SIZES[1:]
        arrays[form] = round((peaks[many]["array"] - peaks[few]["array"]) * MIB / (many - few), 2)
    return {"commands": rows, "bytes_per_event": arrays}, {"bytes_per_event_max": max(arrays.values())}


def measure_cases() -> tuple[dict[str, Any], dict[str, Any]]:
    """Tests of the reference cases."""
    if "POLARNET_SHARED" not in os.environ:
        raise SystemExit("--sections cases: set POLARNET_SHARED to the folder with cases/recordings")
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.xml")
        command = [sys.executable, "-m", "pytest", "-q", "tests/recordings/test_cases.py", f"--junitxml={report}"]
        subprocess.run(command, cwd=ROOT, check=False)
        cases = ElementTree.parse(report).getroot().iter("testcase")
        right = {str(case.get("name")): len(case) == 0 for case in cases}
    return {"right": right}, {"cases_right": sum(right.values()), "cases_total": len(right)}


ONE: dict[str, Callable[[str], Any]] = {
    "reader": speed_of_reader,
    "writer": speed_of_writer,
    "array": peak_of_array,
    **{name: functools.partial(peak_of_command, name) for name in COMMANDS},
}


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/recordings.json")
    parser.add_argument("--sections", nargs="*", choices=SECTIONS, default=SECTIONS)
    everything = [*FILES, *MEMORY_FORMS]
    parser.add_argument("--formats", nargs="*", choices=everything, default=everything)
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    arguments = arguments_of(parser)
    if arguments.one:
        task, about = arguments.one
        print(json.dumps(ONE[task](about)))
        return
    for section in arguments.sections:
        record, known = machine_record(), read_results(ROOT, "recordings").get(section, {})
        if section == "readers":
            figures, headlines = measure_readers([name for name in FILES if name in arguments.formats], known)
        elif section == "memory":
            figures, headlines = measure_memory([name for name in MEMORY_FORMS if name in arguments.formats], known)
        else:
            figures, headlines = measure_cases()
        if arguments.write:
            write_section("recordings", section, figures, record, headlines)


if __name__ == "__main__":
    main()
