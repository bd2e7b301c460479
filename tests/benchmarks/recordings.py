"""How fast recordings are read, and in how much memory: python tests/benchmarks/recordings.py [--write] [--events N]

For each size, a file of random events of a 1280 x 720 sensor (CeleX-5: 1280 x 800), 1 M a second, is written to a
temporary folder, part by part, and read in chunks, in a process of its own whose kernels are compiled. Seconds are the
shortest of the repeats, from opening to the last chunk; the file is in the disk cache. Memory is the most that process
held, less what it held when it had read a small file. Libraries that are installed read the same files whole or in
packets, as they do.

The default, 1 M events, takes a minute; `--events 1000000 100000000` measures the memory of both, with 3 GB of disk.
`--write` puts the figures into docs/results/recordings.json: `readers.NAME.mevents_per_s` of the smallest size, and
`readers.NAME.peak_mib` of each.
"""

import argparse
import importlib.util
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polarnet.events.store import EventStore
from polarnet.events.stream import Events
from polarnet.measure import machine_record, uncommitted, write_section
from polarnet.recordings.formats.celex5_bin_writer import write_celex5_bin
from polarnet.recordings.formats.lines import lines_of
from polarnet.recordings.recording import open_recording

ROOT = Path(__file__).resolve().parents[2]
PART = 1_000_000  # events that are written at a time, and microseconds that they take
SMALL = 20_000  # events: enough to compile every kernel
HEIGHT, WIDTH = 720, 1280


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
        file.write(f"{WIDTH} {HEIGHT}\n".encode())
        for part in parts(count):
            file.write(lines_of(part.T, " "))


def write_bin(event_format: int) -> Callable[[Path, int], None]:
    def write(path: Path, count: int) -> None:
        t, x, y, p = next(parts(count))
        short = (torch.from_numpy(column.astype(np.int16)) for column in (x, y))
        events = Events(torch.from_numpy(t), *short, torch.from_numpy((2 * p - 1).astype(np.int8)), HEIGHT, WIDTH)
        write_celex5_bin(path, events, event_format)
        content = path.read_bytes()
        with path.open("ab") as file:
            for _ in range(PART, count, PART):
                file.write(content[12:])  # its time stamps begin again: a turn of their few bits

    return write


def write_dsec(path: Path, count: int) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        types = {"t": "u4", "x": "u2", "y": "u2", "p": "u1"}
        columns = [file.create_dataset(f"events/{n}", (count,), t, chunks=(2**16,)) for n, t in types.items()]
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


def write_store(path: Path, count: int) -> None:
    t, x, y, p = np.concatenate(list(parts(count)), axis=1)
    types = (np.int64, np.int16, np.int16, np.int8)
    columns = (torch.from_numpy(v.astype(d)) for v, d in zip((t, x, y, 2 * p - 1), types, strict=True))
    events = Events(*columns, HEIGHT, WIDTH)
    store = EventStore.create(path, ["random"], HEIGHT, WIDTH, {})
    nothing = Events.empty(HEIGHT, WIDTH)
    store.write("random", [events, nothing, nothing, nothing], int(t[-1]) + 1)
    store.finish()


def read_own(path: Path) -> int:
    return sum(len(events) for events in open_recording(path, part="0", assume_polarity=1))


def read_faery(path: Path) -> int:
    import faery

    version = {".evt2": "evt2", ".evt3": "evt3", ".dat": "dat2"}[path.suffix]
    kind = "dat" if path.suffix == ".dat" else "evt"
    return sum(map(len, faery.events_stream_from_file(path, file_type=kind, version_fallback=version)))


def read_expelliarmus(path: Path) -> int:
    import expelliarmus

    wizard = expelliarmus.Wizard(encoding=path.suffix[1:])
    wizard.set_file(path)
    return len(wizard.read())


def read_eventcv(path: Path) -> int:
    import eventcv

    suffix = {".evt2": ".raw", ".evt3": ".raw", ".dat": ".dat", ".text": ".txt"}[path.suffix]  # it goes by the name
    link = path.with_name(f"for_eventcv_{path.stem}{suffix}")
    link.unlink(missing_ok=True)
    link.symlink_to(path)
    return len(eventcv.load(str(link), sensor_size=(WIDTH, HEIGHT)).numpy())


def read_numpy(path: Path) -> int:
    return len(np.loadtxt(path, skiprows=1))


FILES: dict[str, Callable[[Path, int], None]] = {
    "celex5_csv": write_csv,
    "celex5_bin": write_bin(1),
    "celex5_bin_format_2": write_bin(2),
    "text": write_lines,
    "dsec": write_dsec,
    "e2p": write_e2p,
    "store": write_store,
    "evt2": write_evt2,
    "evt3": write_evt3,
    "dat": write_dat,
}
LIBRARIES: dict[str, tuple[Callable[[Path], int], tuple[str, ...]]] = {
    "faery": (read_faery, ("evt2", "evt3", "dat")),
    "expelliarmus": (read_expelliarmus, ("evt2", "evt3", "dat")),
    "eventcv": (read_eventcv, ("text", "evt2", "evt3", "dat")),
    "numpy": (read_numpy, ("text",)),
}


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
    """Of this process and of those it started."""
    return max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024


def in_own_process(reader: str, path: Path, small: Path, repeats: int) -> dict[str, float]:
    command = [sys.executable, __file__, "--one", reader, str(path), str(small), "--repeats", str(repeats)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{reader} on {path.name}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def measure(sizes: list[int], names: list[str], repeats: int) -> dict[str, dict[str, Any]]:
    """All figures, printed as they come."""
    figures: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            for size in sizes:
                path, small = Path(folder) / f"large.{name}", Path(folder) / f"small.{name}"
                FILES[name](path, size)
                FILES[name](small, SMALL)
                installed = [lib for lib in LIBRARIES if importlib.util.find_spec(lib)]
                libraries = [lib for lib in installed if name in LIBRARIES[lib][1] and size == sizes[0]]
                for reader in ["own", *libraries]:
                    key = name if reader == "own" else f"{reader}_{name}"
                    one = in_own_process(reader, path, small, repeats if size == sizes[0] else 1)
                    figure = figures.setdefault(key, {"peak_mib": {}})
                    speed = one["events"] / one["seconds"] / 1e6
                    figure.setdefault("mevents_per_s", round(speed, 2))
                    figure["peak_mib"][f"{size / 1e6:g}M"] = round(one["mib"])
                    print(f"{key:24s} {one['events']:11,.0f} events {speed:8.2f} M/s {one['mib']:7.0f} MiB", flush=True)
                remove(path)
                remove(small)
    return figures


def remove(path: Path) -> None:
    if path.is_dir():
        for file in sorted(path.rglob("*"), reverse=True):
            file.rmdir() if file.is_dir() else file.unlink()
        path.rmdir()
    else:
        path.unlink()


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="merge the figures into docs/results/recordings.json")
    parser.add_argument("--events", type=int, nargs="*", default=[PART], help="of each file, smallest first")
    parser.add_argument("--readers", nargs="*", choices=list(FILES), default=list(FILES))
    parser.add_argument("--repeats", type=int, default=5, help="runs of which the fastest counts")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        reader, path, small = arguments.one
        print(json.dumps(measure_one(reader, Path(path), Path(small), arguments.repeats)))
        return
    if arguments.write and (changed := uncommitted(ROOT)):
        parser.error(f"commit first, the figures name a commit; changed:\n{changed}")
    record = machine_record(ROOT)
    figures = measure(sorted(arguments.events), arguments.readers, arguments.repeats)
    if arguments.write:
        path = write_section(ROOT, "recordings", "readers", figures, record)
        print(f"written to {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
