"""Speed and memory of the readers of recordings: python -m studies.speed_of_readers [--write] [--formats NAME ...]

For each format and size, the study writes a file of random events, 1 M a second, of a 1280 x 720 sensor. polarnet reads
it in chunks; every installed library (faery; `pip install eventcv expelliarmus`) whole or in packets, as its interface
does, each in its own process. Times are the shortest of five runs with the file in the disk cache, of the smaller size.
Memory is the peak of the process and its children, minus that after reading a small file (Linux).
"""

import argparse
import importlib.metadata
import importlib.util
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from polarnet.events.stream import Events
from polarnet.recordings.formats.lines import lines_of
from polarnet.recordings.recording import open_recording
from polarnet.recordings.writers import write_hdf5
from studies.study import ROOT, arguments_of, command_line, in_own_process, machine_record, read_results, write_section

PART = 1_000_000  # events that are written at a time, and microseconds that they take
SIZES = {"1M": 1_000_000, "10M": 10_000_000}
SMALL = 20_000  # events: enough to compile every kernel
REPEATS = 5
HEIGHT, WIDTH = 720, 1280


def parts(count: int) -> Iterator[np.ndarray]:
    """Rows t, x, y, p: the same part again and again, later each time."""
    generator = np.random.default_rng(0)
    size = min(count, PART)
    t = np.sort(generator.integers(0, PART, size))
    x, y, p = (generator.integers(0, limit, size) for limit in (WIDTH, HEIGHT, 2))
    for start in range(0, count, PART):
        yield np.stack([t + start, x, y, p])


def write_by_parts(header: bytes, content_of: Callable[[np.ndarray], bytes]) -> Callable[[Path, int], None]:
    """A writer of a header and of each part's bytes."""

    def write(path: Path, count: int) -> None:
        with path.open("wb") as file:
            file.write(header)
            for part in parts(count):
                file.write(content_of(part))

    return write


def evt2_words(part: np.ndarray) -> bytes:
    t, x, y, p = part
    words = np.stack([8 << 28 | t >> 6, p << 28 | (t & 63) << 22 | x << 11 | y], axis=1)
    return words[np.stack([np.diff(t >> 6, prepend=-1) != 0, t >= 0], axis=1)].astype("<u4").tobytes()


def evt3_words(part: np.ndarray) -> bytes:
    t, x, y, p = part
    words = np.stack([0x8000 | t >> 12 & 0xFFF, 0x6000 | t & 0xFFF, y, 0x2000 | p << 11 | x], axis=1)
    new = np.stack([np.diff(t >> 12, prepend=-1) != 0, np.diff(t, prepend=-1) != 0], axis=1)
    return words[np.hstack([new, np.ones_like(new)])].astype("<u2").tobytes()


def dat_words(part: np.ndarray) -> bytes:
    t, x, y, p = part
    return np.stack([t, x | y << 14 | p << 28], axis=1).astype("<u4").tobytes()


def write_dsec(path: Path, count: int) -> None:
    t, x, y, p = np.concatenate(list(parts(count)), axis=1)
    write_hdf5(path, Events.from_columns(t, x, y, 2 * p - 1, HEIGHT, WIDTH), count)


def write_aedat4(path: Path, count: int) -> None:
    import faery

    rows = np.empty(count, faery.EVENTS_DTYPE)
    for name, column in zip(("t", "x", "y", "on"), np.concatenate(list(parts(count)), axis=1), strict=True):
        rows[name] = column
    faery.events_stream_from_array(rows, (WIDTH, HEIGHT)).to_file(path)


def read_own(path: Path) -> int:
    height, width = (HEIGHT, WIDTH) if path.suffix == ".text" else (None, None)
    return sum(map(len, open_recording(path, height=height, width=width)))


def read_faery(path: Path) -> int:
    import faery

    kinds = {".evt2": ("evt", "evt2"), ".evt3": ("evt", "evt3"), ".dat": ("dat", "dat2"), ".aedat4": ("aedat", None)}
    kind, version = kinds[path.suffix]
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
    endings = {".evt2": ".raw", ".evt3": ".raw", ".text": ".txt"}
    link = path.with_suffix(endings.get(path.suffix, path.suffix))
    if not link.exists():
        link.hardlink_to(path)  # some look where a symbolic one leads
    return link


PROPHESEE = b"% evt {v}.0\n% format EVT{v};height=720;width=1280\n% geometry 1280x720\n% end\n"
FILES: dict[str, Callable[[Path, int], None]] = {
    "text": write_by_parts(b"", lambda part: lines_of(part.T, " ")),
    "dsec": write_dsec,
    "evt2": write_by_parts(PROPHESEE.replace(b"{v}", b"2"), evt2_words),
    "evt3": write_by_parts(PROPHESEE.replace(b"{v}", b"3"), evt3_words),
    "dat": write_by_parts(b"% Version 2\n% Height 720\n% Width 1280\n\x0c\x08", dat_words),
    "aedat4": write_aedat4,
}
READERS: dict[str, tuple[Callable[[Path], int], tuple[str, ...]]] = {
    "polarnet": (read_own, tuple(FILES)),
    "faery": (read_faery, ("evt2", "evt3", "dat", "aedat4")),
    "expelliarmus": (read_expelliarmus, ("evt2", "evt3", "dat")),
    "eventcv": (read_eventcv, ("text", "evt2", "evt3", "dat", "aedat4")),
}
"""Readers and the formats that each supports."""


def measure_one(reader: str, path: Path, small: Path) -> dict[str, float]:
    """In a process of its own: events, seconds, MiB."""
    read, _ = READERS[reader]
    read(small)
    before, seconds = peak_mib(), []
    for _ in range(REPEATS):
        start = time.perf_counter()
        count = read(path)
        seconds.append(time.perf_counter() - start)
    return {"events": count, "seconds": min(seconds), "mib": peak_mib() - before}


def peak_mib() -> float:
    """Peak memory in MiB of this process and its children."""
    own = psutil.Process()
    marks = [Path(f"/proc/{process.pid}/status").read_text() for process in (own, *own.children(recursive=True))]
    return sum(int(line.split()[1]) for mark in marks for line in mark.splitlines() if line.startswith("VmHWM")) / 1024


def measure(name: str) -> dict[str, Any]:
    """Millions of events a second of each reader of a format, and the peak memory of polarnet's by size."""
    speeds: dict[str, float] = {}
    memory: dict[str, int] = {}
    for label, size in SIZES.items():
        with tempfile.TemporaryDirectory() as folder:
            path, small = Path(folder, f"large.{name}"), Path(folder, f"small.{name}")
            FILES[name](path, size)
            FILES[name](small, SMALL)
            for reader, (_, formats) in READERS.items():
                if name not in formats or not importlib.util.find_spec(reader) or (memory and reader != "polarnet"):
                    continue
                one = in_own_process("studies.speed_of_readers", "--one", reader, path, small)
                if one["events"] != size:
                    raise RuntimeError(f"{path.name}: expected {size} events, {reader} read {one['events']}")
                speeds.setdefault(reader, round(one["events"] / one["seconds"] / 1e6, 2))
                if reader == "polarnet":
                    memory[label] = round(one["mib"])
    print(name, speeds, memory, flush=True)
    return {"mevents_per_s": speeds, "peak_mib": memory}


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/recordings.json")
    parser.add_argument("--formats", nargs="*", choices=list(FILES), default=list(FILES))
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    arguments = arguments_of(parser)
    if arguments.one:
        reader, path, small = arguments.one
        print(json.dumps(measure_one(reader, Path(path), Path(small))))
        return
    record = machine_record()
    record["versions"] |= {name: importlib.metadata.version(name) for name in READERS if importlib.util.find_spec(name)}
    figures = {name: measure(name) for name in arguments.formats}
    if arguments.write:
        known = read_results(ROOT, "recordings").get("readers", {})
        write_section("recordings", "readers", known | figures, record)


if __name__ == "__main__":
    main()
