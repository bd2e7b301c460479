"""Speed and memory of recordings: python -m studies.recordings [--write] [--only NAME ...]

Sections of docs/results/recordings.json, each measured in processes of their own:

- `readers`: M events per CPU second of every reader and of `polarnet inspect`, on 10 M random events, 1 M a second, of
  a 1280 x 720 sensor where the format has no other (10 k events a packet or message). The CPU time is that of the
  process and its children, the shortest of three runs, with the file in the disk cache. Writers: the same from memory.
- `memory`: peak of `inspect`, `convert` and `recover --method highpass` on 2 to 128 M events of a 346 x 260 sensor,
  and bytes of `read_recording` for each event more, between 8 and 32 M events.
- `cases`: the reference cases, with POLARNET_SHARED: what their table says of each and of polarnet before,
  and what their tests see now.
"""

import argparse
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch

from polarnet.cli import main as polarnet
from polarnet.events.stream import Events, concatenate
from polarnet.recordings.recording import open_recording, read_recording
from polarnet.recordings.writers import FORMS
from studies.recording_files import FILES
from studies.study import command_line, in_own_process, measure_sections, outcomes

COUNT, SMALL = 10_000_000, 20_000  # events; the small file compiles every kernel
PART = 1_000_000  # events that are made at a time, and microseconds that they take
REPEATS = 3
SENSORS = {"aedat2": (260, 346), "aedat3": (480, 640), "celex5_csv": (800, 1280), "celex5_bin": (800, 1280)}
SENSOR = 720, 1280  # of the other formats
PARTS = {"m3ed": "left", "mvsec": "left"}
MEMORY_SIZES = (2_000_000, 8_000_000, 32_000_000, 128_000_000)
MEMORY_SENSOR = 260, 346
MEMORY_FORMS = ("evt3", "hdf5", "text")
COMMANDS: dict[str, list[str]] = {
    "inspect": ["--out", "OUT"],
    "convert": ["OUT"],
    "recover": ["--method", "highpass", "--mosaic", "90 45 / 135 0", "--write", "zarr", "--out", "OUT"],
}
ARRAY = "array"  # stands for `read_recording` among the commands
MIB = 2**20


def parts(count: int, height: int, width: int) -> Iterator[Events]:
    """The same random events again and again, later each time."""
    generator = torch.Generator().manual_seed(0)
    size = min(count, PART)
    t = torch.randint(PART, (size,), generator=generator).sort().values
    x, y, p = (torch.randint(limit, (size,), generator=generator) for limit in (width, height, 2))
    for start in range(0, count, PART):
        yield Events(t + start, x.short(), y.short(), (2 * p - 1).to(torch.int8), height, width)


def cpu_s() -> float:
    """CPU seconds of this process and its children."""
    own = psutil.Process()
    times = [one.cpu_times() for one in (own, *own.children(recursive=True))]
    return sum(one.user + one.system for one in times) + own.cpu_times().children_user


def shortest_cpu_s(run: Callable[[], object]) -> float:
    """CPU seconds of the fastest of three runs."""
    marks = [cpu_s()]
    for _ in range(REPEATS):
        run()
        marks.append(cpu_s())
    return float(np.diff(marks).min())


def speed_of_reader(kind: str) -> dict[str, float]:
    """M events per CPU second of `open_recording` and of `polarnet inspect`."""
    suffix, write = FILES[kind]
    sensor, part = SENSORS.get(kind, SENSOR), PARTS.get(kind)
    with tempfile.TemporaryDirectory() as folder:
        large, small = Path(folder, f"large{suffix}"), Path(folder, f"small{suffix}")
        write(large, concatenate(list(parts(COUNT, *sensor))))
        write(small, concatenate(list(parts(SMALL, *sensor))))

        def read(path: Path) -> int:
            return sum(map(len, open_recording(path, part=part)))

        def inspect(path: Path) -> None:
            if polarnet(["inspect", str(path), "--out", folder, *(["--part", part] if part else [])]):
                raise RuntimeError(f"{kind}: polarnet inspect failed")

        read(small)
        inspect(small)
        count = read(large)
        if count < 0.99 * COUNT:  # a CeleX-5 has no polarity where the intensity stays
            raise RuntimeError(f"{kind}: expected {COUNT} events, read {count}")
        seconds = {"read": shortest_cpu_s(lambda: read(large)), "inspect": shortest_cpu_s(lambda: inspect(large))}
    return {key: round(count / one / 1e6, 2) for key, one in seconds.items()}


def speed_of_writer(form: str) -> float:
    """M events per CPU second of a writer."""
    suffix, write = FORMS[form]
    events = concatenate(list(parts(COUNT, *SENSOR)))
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder, f"small{suffix}"), parts(SMALL, *SENSOR))
        return round(COUNT / shortest_cpu_s(lambda: write(Path(folder, f"large{suffix}"), events)) / 1e6, 2)


def peak_mib() -> float:
    """Peak memory in MiB of this process and its children."""
    own = psutil.Process()
    marks = [Path(f"/proc/{process.pid}/status").read_text() for process in (own, *own.children(recursive=True))]
    return sum(int(line.split()[1]) for mark in marks for line in mark.splitlines() if line.startswith("VmHWM")) / 1024


def peak_of(command: str, path: str) -> float:
    """Peak memory in MiB of a command of polarnet on a file, or of `read_recording`."""
    with tempfile.TemporaryDirectory() as folder:
        if command == ARRAY:
            read_recording(path)
        elif polarnet([command, path, *(word.replace("OUT", f"{folder}/out.h5") for word in COMMANDS[command])]):
            raise RuntimeError(f"polarnet {command} {path} failed")
    return round(peak_mib(), 1)


def measure_readers(_: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """Speed of the readers and writers."""
    files = {name: in_own_process(speed_of_reader, name) for name in FILES}
    writers = {form: in_own_process(speed_of_writer, form) for form in FORMS}
    return {"files": files, "writers": writers}, {"readers_mev_per_cpu_s": {n: one["read"] for n, one in files.items()}}


def measure_memory(_: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """Peak memory of the commands, and bytes an event of an array."""
    rows: dict[str, dict[str, int]] = {}
    arrays = {}
    for form in MEMORY_FORMS:
        suffix, write = FORMS[form]
        peaks: dict[int, dict[str, float]] = {}
        for size in MEMORY_SIZES:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, f"recording{suffix}")
                write(path, parts(size, *MEMORY_SENSOR))
                peaks[size] = {name: in_own_process(peak_of, name, str(path)) for name in (*COMMANDS, ARRAY)}
        for name in COMMANDS:
            rows[f"{name}, {form}"] = {f"{size // 1_000_000}M": round(one[name]) for size, one in peaks.items()}
        few, many = MEMORY_SIZES[1:3]
        arrays[form] = round((peaks[many][ARRAY] - peaks[few][ARRAY]) * MIB / (many - few), 2)
    return {"commands": rows, "bytes_per_event": arrays}, {"bytes_per_event_max": max(arrays.values())}


def measure_cases(_: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """The table of the reference cases, and what their tests see now."""
    if "POLARNET_SHARED" not in os.environ:
        raise SystemExit("--only cases: set POLARNET_SHARED to the folder with cases/recordings")
    tests = outcomes("tests/recordings/test_cases.py")
    text = Path(os.environ["POLARNET_SHARED"], "cases", "recordings", "README.md").read_text(encoding="utf-8")
    table = []
    for row in re.findall(r"(?m)^\| (`.*) \|$", text):
        files, situation, before = row.split(" | ")
        seen: dict[str, Any] = {}
        for name, test in tests.items():
            file = name.partition("[")[2][:-1]
            if named(file, files):
                seen[file] = "; ".join(filter(None, [seen.get(file), test.get("now") if test["passed"] else "failed"]))
        table.append({"files": files, "situation": situation, "before": before, "now": one_line(seen)})
    right = {name: test["passed"] for name, test in tests.items()}
    return {"table": table, "right": right}, {"cases_right": sum(right.values()), "cases_total": len(right)}


def named(file: str, files: str) -> bool:
    """Whether a cell names a file or the folder that it lies in; `a_{1,2}.txt` stands for two."""
    names = re.findall("`([^`]+)`", files)
    patterns = (re.escape(name).replace(r"\{", "(").replace(r"\}", ")").replace(",", "|") for name in names)
    return any(re.fullmatch(f"{pattern}(/.*)?", file) for pattern in patterns)


def one_line(seen: Mapping[str, str]) -> str:
    """Findings by file in a line; files with the same findings stand together."""
    files: dict[str, list[str]] = {}
    for file, what in seen.items():
        files.setdefault(what, []).append(file)
    if len(files) == 1:
        return next(iter(files))
    return "<br>".join(f"`{', '.join(names)}`: {what}" for what, names in files.items())


SECTIONS = {"readers": measure_readers, "memory": measure_memory, "cases": measure_cases}

if __name__ == "__main__":
    sections = {name: ("recordings", name, measure) for name, measure in SECTIONS.items()}
    measure_sections(command_line(__doc__, "docs/results/recordings.json"), sections)
