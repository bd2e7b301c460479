"""Speed and memory of the readers of recordings: python -m studies.recordings [--write] [--full]

For each format and size, the study writes a file of random events, 1 M a second, of a 1280 x 720 sensor (CeleX-5: 1280
x 800, AEDAT-2: 346 x 260) to a temporary folder. polarnet reads it in chunks; every installed library (faery; `pip
install eventcv expelliarmus aedat dv-processing`) reads it whole or in packets, as its interface does. Every reader
runs in its own process with compiled kernels. Times are the shortest of the repeats, from opening to the last chunk,
with the file in the disk cache. Memory is the peak of the process and its children, minus their memory after reading a
small file (Linux: high-water marks of resident memory).

Sizes are 1 M and 10 M events, and 100 M with --full (3 GB of disk; a store is written whole and needs 8 GB of memory).
The speed is that of the smallest size. `--write` puts `readers.NAME.mevents_per_s` and `readers.NAME.peak_mib` into
docs/results/recordings.json; formats that did not run keep their figures and the commit of these figures.
"""

import argparse
import importlib.metadata
import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch

from polarnet.events.stream import Events
from polarnet.recordings.formats.lines import lines_of
from polarnet.recordings.recording import open_recording
from polarnet.storage.events import EventStore
from studies.celex5_writer import write_celex5_bin
from studies.measure import arguments_of, command_line, machine_record, read_results, write_section

ROOT = Path(__file__).resolve().parents[1]
PART = 1_000_000  # events that are written at a time, and microseconds that they take
SIZES, LARGEST = (1_000_000, 10_000_000), 100_000_000  # events
SMALL = 20_000  # events: enough to compile every kernel
HEIGHT, WIDTH = 720, 1280
POLARITY_BY_CHANGE = ("celex5_bin",)  # random polarities need some events more, repeated parts lose some


def parts(count: int) -> Iterator[np.ndarray]:
    """Rows t, x, y, p: the same part again and again, later each time."""
    generator = np.random.default_rng(0)
    size = min(count, PART)
    t = np.sort(generator.integers(0, PART, size))
    x, y, p = (generator.integers(0, limit, size) for limit in (WIDTH, HEIGHT, 2))
    for start in range(0, count, PART):
        yield np.stack([t + start, x, y, p])


def write_csv(path: Path, count: int) -> None:
    with path.open("wb") as file:
        for t, x, y, p in parts(count):
            file.write(lines_of(np.stack([y, x, x, 2 * p - 1, t], axis=1), ","))


def write_lines(path: Path, count: int) -> None:
    with path.open("wb") as file:
        for part in parts(count):
            file.write(lines_of(part.T, " "))


def events_of(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> Events:
    """Events of one channel from columns of any integer type; `p` is 0 or 1."""
    types = (np.int64, np.int16, np.int16, np.int8)
    t_us, column, row, polarity = (
        torch.from_numpy(values.astype(kind)) for values, kind in zip((t, x, y, 2 * p - 1), types, strict=True)
    )
    return Events(t_us, column, row, polarity, HEIGHT, WIDTH)


def write_bin(path: Path, count: int) -> None:
    t, x, y, p = next(parts(count))
    write_celex5_bin(path, events_of(t, x, y, p))
    content = path.read_bytes()
    with path.open("ab") as file:
        for _ in range(PART, count, PART):
            file.write(content[12:])  # its time stamps begin again: a turn of their few bits


def write_dsec(path: Path, count: int) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        types = {"t": "u4", "x": "u2", "y": "u2", "p": "u1"}
        chunk = (min(count, 2**16),)
        columns = [file.create_dataset(f"events/{n}", (count,), t, chunks=chunk) for n, t in types.items()]
        for k, part in enumerate(parts(count)):
            for column, values in zip(columns, part, strict=True):
                column[k * PART : k * PART + len(values)] = values
        file.attrs["height"], file.attrs["width"] = HEIGHT, WIDTH


def write_e2p(path: Path, count: int) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        table = file.create_dataset("events", (count, 4), "u4", chunks=(2**14, 4))
        for k, part in enumerate(parts(count)):
            table[k * PART : k * PART + part.shape[1]] = part.T
        file.attrs["sensor_resolution"] = (WIDTH, HEIGHT)


def write_evt2(path: Path, count: int) -> None:
    with path.open("wb") as file:
        file.write(b"% evt 2.0\n% format EVT2;height=720;width=1280\n% geometry 1280x720\n% end\n")
        for t, x, y, p in parts(count):
            words = np.stack([8 << 28 | t >> 6, p << 28 | (t & 63) << 22 | x << 11 | y], axis=1)
            file.write(words[np.stack([np.diff(t >> 6, prepend=-1) != 0, t >= 0], axis=1)].astype("<u4").tobytes())


def write_evt3(path: Path, count: int) -> None:
    with path.open("wb") as file:
        file.write(b"% evt 3.0\n% format EVT3;height=720;width=1280\n% geometry 1280x720\n% end\n")
        for t, x, y, p in parts(count):
            words = np.stack([0x8000 | t >> 12 & 0xFFF, 0x6000 | t & 0xFFF, y, 0x2000 | p << 11 | x], axis=1)
            new = np.stack([np.diff(t >> 12, prepend=-1) != 0, np.diff(t, prepend=-1) != 0], axis=1)
            file.write(words[np.hstack([new, np.ones_like(new)])].astype("<u2").tobytes())


def write_dat(path: Path, count: int) -> None:
    with path.open("wb") as file:
        file.write(b"% Version 2\n% Height 720\n% Width 1280\n\x0c\x08")
        for t, x, y, p in parts(count):
            file.write(np.stack([t, x | y << 14 | p << 28], axis=1).astype("<u4").tobytes())


def write_aedat2(path: Path, count: int) -> None:
    with path.open("wb") as file:
        file.write(b"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.Davis346blue\r\n")
        for t, x, y, p in parts(count):
            file.write(np.stack([(y % 260) << 22 | (x % 346) << 12 | p << 11, t], axis=1).astype(">u4").tobytes())


def write_store(path: Path, count: int) -> None:
    t, x, y, p = np.concatenate(list(parts(count)), axis=1)
    events = events_of(t, x, y, p)
    store = EventStore.create(path, ["random"], HEIGHT, WIDTH, {})
    nothing = Events.empty(HEIGHT, WIDTH)
    store.write("random", [events, nothing, nothing, nothing], int(t[-1]) + 1)
    store.finish()


def write_by_faery(ending: str) -> Callable[[Path, int], None]:
    def write(path: Path, count: int) -> None:
        import faery

        rows = np.empty(count, faery.EVENTS_DTYPE)
        for name, column in zip(("t", "x", "y", "on"), np.concatenate(list(parts(count)), axis=1), strict=True):
            rows[name] = column
        written = path.with_suffix(ending)  # it goes by the name
        faery.events_stream_from_array(rows, (WIDTH, HEIGHT)).to_file(written)
        written.rename(path)

    return write


def read_own(path: Path) -> int:
    height, width = (HEIGHT, WIDTH) if path.suffix == ".text" else (None, None)
    reader = open_recording(path, height=height, width=width, part="0")
    return sum(map(len, reader))


def read_faery(path: Path) -> int:
    import faery

    kind, version = {
        ".evt2": ("evt", "evt2"), ".evt3": ("evt", "evt3"), ".dat": ("dat", "dat2"), ".aedat4": ("aedat", None),
        ".event_stream": ("es", None),
    }[path.suffix]  # fmt: skip
    return sum(map(len, faery.events_stream_from_file(path, file_type=kind, version_fallback=version)))


def read_expelliarmus(path: Path) -> int:
    import expelliarmus

    wizard = expelliarmus.Wizard(encoding=path.suffix[1:])
    wizard.set_file(named(path))
    return len(wizard.read())


def read_eventcv(path: Path) -> int:
    import eventcv

    return len(eventcv.load(str(named(path)), sensor_size=(WIDTH, HEIGHT)).numpy())


def named(path: Path) -> Path:
    """The same file under the ending that libraries expect, which go by the name."""
    link = path.with_suffix(
        {".evt2": ".raw", ".evt3": ".raw", ".text": ".txt", ".aedat2": ".aedat"}.get(path.suffix, path.suffix)
    )
    if not link.exists():
        link.hardlink_to(path)  # some look where a symbolic one leads
    return link


def read_aedat(path: Path) -> int:
    import aedat

    return sum(len(packet["events"]) for packet in aedat.Decoder(str(path)) if "events" in packet)


def read_dv_processing(path: Path) -> int:
    import dv_processing

    recording, count = dv_processing.io.MonoCameraRecording(str(path)), 0
    while (packet := recording.getNextEventBatch()) is not None:
        count += len(packet.numpy())
    return count


def read_numpy(path: Path) -> int:
    return len(np.loadtxt(path))


FILES: dict[str, Callable[[Path, int], None]] = {
    "celex5_csv": write_csv,
    "celex5_bin": write_bin,
    "text": write_lines,
    "dsec": write_dsec,
    "e2p": write_e2p,
    "store": write_store,
    "evt2": write_evt2,
    "evt3": write_evt3,
    "dat": write_dat,
    "aedat2": write_aedat2,
    "aedat4": write_by_faery(".aedat4"),
    "event_stream": write_by_faery(".es"),
}
LIBRARIES: dict[str, tuple[Callable[[Path], int], tuple[str, ...]]] = {
    "faery": (read_faery, ("evt2", "evt3", "dat", "aedat4", "event_stream")),
    "expelliarmus": (read_expelliarmus, ("evt2", "evt3", "dat")),
    "eventcv": (read_eventcv, ("text", "evt2", "evt3", "dat", "aedat2", "aedat4")),
    "aedat": (read_aedat, ("aedat4",)),
    "dv_processing": (read_dv_processing, ("aedat4",)),
    "numpy": (read_numpy, ("text",)),
}
"""Readers of a library and the formats that it supports."""


def measure_one(reader: str, path: Path, small: Path, repeats: int) -> dict[str, float]:
    """In a process of its own: events, seconds, MiB."""
    read = read_own if reader == "own" else LIBRARIES[reader][0]
    read(small)
    before = peak_mib()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        count = read(path)
        seconds.append(time.perf_counter() - start)
    return {"events": count, "seconds": min(seconds), "mib": peak_mib() - before}


def peak_mib() -> float:
    """Peak memory in MiB of this process and its children."""
    own = psutil.Process()
    marks = [Path(f"/proc/{process.pid}/status").read_text() for process in (own, *own.children(recursive=True))]
    return sum(int(line.split()[1]) for mark in marks for line in mark.splitlines() if line.startswith("VmHWM")) / 1024


def in_own_process(reader: str, path: Path, small: Path, repeats: int) -> dict[str, float]:
    command = [
        sys.executable,
        "-m",
        "studies.recordings",
        "--one",
        reader,
        str(path),
        str(small),
        "--repeats",
        str(repeats),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{reader} on {path.name}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def measure(name: str, sizes: list[int], repeats: int) -> dict[str, dict[str, Any]]:
    """Figures of all readers of a format, printed as they come."""
    figures: dict[str, dict[str, Any]] = {}
    libraries = [lib for lib, (_, formats) in LIBRARIES.items() if name in formats and importlib.util.find_spec(lib)]
    with tempfile.TemporaryDirectory() as folder:
        for size in sizes:
            path, small = Path(folder) / f"large.{name}", Path(folder) / f"small.{name}"
            FILES[name](path, size)
            FILES[name](small, SMALL)
            held: float = size
            for reader in ["own", *(libraries if size == sizes[0] else [])]:
                one = in_own_process(reader, path, small, repeats if size == sizes[0] else 1)
                held = one["events"] if reader == "own" else held
                if one["events"] != held or (held != size and name not in POLARITY_BY_CHANGE):
                    raise RuntimeError(f"{reader} found {one['events']} of {size} events in {path.name}, own {held}")
                figure = figures.setdefault(name if reader == "own" else f"{reader}_{name}", {"peak_mib": {}})
                speed = one["events"] / one["seconds"] / 1e6
                figure.setdefault("mevents_per_s", round(speed, 2))
                figure["peak_mib"][f"{size / 1e6:g}M"] = round(one["mib"])
                print(f"{name:20s} {reader:14s} {one['events']:11,d} events {speed:7.2f} M/s {one['mib']:6.0f} MiB")
            for left in Path(folder).iterdir():
                shutil.rmtree(left) if left.is_dir() else left.unlink()
    return figures


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/recordings.json")
    parser.add_argument("--full", action="store_true", help="100 M events too")
    parser.add_argument("--formats", nargs="*", choices=list(FILES), default=list(FILES))
    parser.add_argument("--repeats", type=int, default=5, help="runs of which the fastest counts")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    arguments = arguments_of(parser)
    if arguments.one:
        reader, path, small = arguments.one
        print(json.dumps(measure_one(reader, Path(path), Path(small), arguments.repeats)))
        return
    for name in arguments.formats:
        record = machine_record(ROOT)
        record["versions"] |= {
            lib: importlib.metadata.version(lib) for lib in LIBRARIES if importlib.util.find_spec(lib)
        }
        figures = measure(name, [*SIZES, *([LARGEST] if arguments.full else [])], arguments.repeats)
        if arguments.write:
            known = read_results(ROOT, "recordings").get("readers", {})
            latest = {reader: figure | {"commit": record["commit"]} for reader, figure in figures.items()}
            path = write_section(ROOT, "recordings", "readers", known | latest, record)
            print(f"written to {path.relative_to(ROOT)}", flush=True)


if __name__ == "__main__":
    main()
