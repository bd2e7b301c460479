"""Speed of the network, the emulator and recovery: python -m studies.speed [--only network|simulation|live] [--write]

- network: windows a second on random points that move, for each size of sensor, many at once as in a file and one by
  one as from a camera, with and without blocks of 2x2 pixels (`methods.ours.binning=2`). --write:
  docs/results/robustness.json, section speed.
- network with --before CHECKOUT: the same of an older checkout of this repository, in turns with this one, and the
  ratios of the medians. --write: docs/results/speed.json, section turns, and speedup_HEIGHTxWIDTH of files and cameras.
- simulation: events of one drifting sensor (`studies.simulation_run`). Times are medians of wall-clock time. Every
  model and number of threads runs in its own process; the processes take turns, so that other load affects all of them
  alike. --write: docs/results/emulation.json.
- simulation with --before CHECKOUT: processor time of v2e and exact on one thread, of both checkouts in turns.
  --write: docs/results/speed.json, section simulation_turns.
- live: `polarnet recover` of a million random events a second on 260 x 346 pixels, with every output and with numbers
  alone. From a store: how many times as fast as real time. `--live`, `--seconds` (60) of lines through a pipe: latency,
  joined windows, and memory in the second and the last third of the time. --write: docs/results/speed.json.
"""

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polarnet.config.tree import load
from polarnet.events.stream import Events, concatenate
from polarnet.events.streaming import EventWindow, WindowCutter, WindowRule
from polarnet.methods.dolp_network import dolp_recoverer
from polarnet.networks.registry import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.recordings.arrangements import shifted
from polarnet.reports.artefacts import git
from polarnet.runtime.machine import configure, precision_on, usable_cores
from polarnet.storage.events import EventStore
from studies import simulation_run
from studies.study import ROOT, arguments_of, command_line, in_own_process, machine_record, write_section

SIZES = ((120, 180), (260, 346), (480, 640))
RUNS, TIMED_WINDOWS, WARM_RUNS = 3, 12, 3
KINDS = ("file", "camera")
CPU = torch.device("cpu")
SHIFT = 2  # pixels per window of the points, whose motion the network finds
EVENTS_PER_PIXEL = 0.8  # a window; the default sensor's mean
WINDOW_US = round(1e6 / 30)
MODELS = ("v2e", "exact", "esim", "dvs_voltmeter")
THREADS = (1, 2)
LIVE_SIZE, EVENTS_PER_S, CHUNKS_PER_S, FILE_SECONDS, LIVE_DIGITS = (260, 346), 1_000_000, 100, 10, 10
ROUNDS, PAIRS = 3, 12  # processes of each model and number of threads; of each checkout


def windows_per_s(height: int, width: int, binning: int | None) -> dict[str, float]:
    """Windows a second of the network on random points that move, in memory, as precise as `recover`.

    `file` takes as many at once as `recover` of a file, `camera` one after the other.
    """
    recoverer = dolp_recoverer(*load_network(shipped_weights()), CPU, precision_on(CPU, "auto"), binning=binning)
    rates = {}
    for name, size, runs in (("file", recoverer.at_once(height, width), RUNS), ("camera", 1, TIMED_WINDOWS)):
        count = size * (WARM_RUNS + runs)
        windows = windows_of(random_channels(height, width, count), count)
        state = recoverer.start(height, width)
        for number in range(WARM_RUNS + runs):
            if number == WARM_RUNS:
                start = time.perf_counter()
            state, _ = recoverer.step(state, windows[number * size : (number + 1) * size])
        rates[name] = round(size * runs / (time.perf_counter() - start), 2)
    return rates


def random_channels(height: int, width: int, windows: int) -> list[Events]:
    """Events of four channels, as long as this number of windows: random points that move to the right."""
    generator = np.random.default_rng(0)
    count = round(EVENTS_PER_PIXEL * height * width)
    number = np.repeat(np.arange(windows), count)

    def random_channel() -> Events:
        t = WINDOW_US * number + np.sort(generator.integers(0, WINDOW_US, (windows, count))).ravel()
        y, x = (np.tile(generator.integers(0, size, count), windows) for size in (height, width))
        p = np.tile(generator.choice([-1, 1], count), windows)
        return Events.from_columns(t, (x + SHIFT * number) % width, y, p, height, width)

    return [random_channel() for _ in range(4)]


def windows_of(channels: Sequence[Events], windows: int) -> list[EventWindow]:
    """The first windows of the channels, one after the other."""
    cutter = WindowCutter(WindowRule(WINDOW_US, None, None), channels[0].height, channels[0].width)
    return list(cutter.add(channels, windows * WINDOW_US))


def measure_network(threads: int) -> dict[str, Any]:
    """Windows a second by size of sensor, with and without blocks."""
    config = load(ROOT, [f"runtime.threads={threads}"])
    configure(config.runtime, config.seed)
    kinds = {"pixels": None, "blocks": 2}
    sizes = {
        f"{height} x {width}": {kind: windows_per_s(height, width, side) for kind, side in kinds.items()}
        for height, width in SIZES
    }
    return {"threads": threads, "precision": precision_on(CPU, "auto"), "sizes": sizes}


def in_turns(before: Path, rounds: int, *script: object) -> dict[Path, list[dict[str, Any]]]:
    """What a script of this checkout prints as JSON with the packages of `before` and with those of this one, in turns.

    Each checkout goes first in every other round.
    """
    turns: dict[Path, list[dict[str, Any]]] = {before: [], ROOT: []}
    for number in range(rounds):
        for root in list(turns)[:: (-1) ** number]:
            environment = {**os.environ, "PYTHONPATH": str(root)}
            command = [sys.executable, *map(str, script)]
            done = subprocess.run(command, cwd=root, env=environment, stdout=subprocess.PIPE, text=True, check=True)
            turns[root].append(json.loads(done.stdout.splitlines()[-1]))
    return turns


def measure_turns(before: Path, threads: int) -> dict[str, Any]:
    """Medians of windows a second of the checkout `before` and of this one, which take turns, and their ratios."""
    turns = in_turns(before, ROUNDS, __file__, "--sizes", threads)

    def medians(root: Path, size: str) -> dict[str, float]:
        return {kind: float(np.median([one["sizes"][size]["pixels"][kind] for one in turns[root]])) for kind in KINDS}

    sizes = {}
    for size in turns[ROOT][0]["sizes"]:
        old, new = medians(before, size), medians(ROOT, size)
        sizes[size] = {"before": old, "now": new, "speedup": {kind: round(new[kind] / old[kind], 2) for kind in KINDS}}
    return {"threads": threads, "commit_before": git(before, "rev-parse", "HEAD"), "sizes": sizes}


def measure_simulation_turns(before: Path) -> dict[str, Any]:
    """Processor time of a run by model on one thread, of the checkout `before` and of this one, and their ratios.

    A ratio is the median of those of the processes that ran one after the other.
    """
    figures: dict[str, Any] = {"commit_before": git(before, "rev-parse", "HEAD"), "pairs": PAIRS}
    for model in MODELS[:2]:
        turns = in_turns(before, PAIRS, simulation_run.__file__, model, 1)
        old, new = (np.array([np.median(one["cpu_seconds"]) for one in turns[root]]) for root in (before, ROOT))
        events = {str(one["events"]) for root in turns for one in turns[root]}
        figures[model] = {
            "cpu_seconds_before": round(float(np.median(old)), 4),
            "cpu_seconds": round(float(np.median(new)), 4),
            "time_over_before": round(float(np.median(new / old)), 3),
            "events": "equal in number" if len(events) == 1 else "of other numbers",
        }
    return figures


def measure_models() -> dict[str, dict[str, Any]]:
    """Seconds on one and two threads, rate of events and peak memory by model."""
    runs: dict[tuple[str, int], list[dict[str, Any]]] = {(model, t): [] for model in MODELS for t in THREADS}
    for _ in range(ROUNDS):
        for model, threads in runs:
            runs[model, threads].append(in_own_process("studies.simulation_run", model, threads))
    seconds = {key: float(np.median([s for one in of_key for s in one["seconds"]])) for key, of_key in runs.items()}
    return {
        model: {
            "seconds_1_thread": round(seconds[model, 1], 4),
            "seconds_2_threads": round(seconds[model, 2], 4),
            "mevents_per_s": round(runs[model, 1][0]["events"] / seconds[model, 1] * 1e-6, 2),
            "peak_mib": runs[model, 1][0]["peak_mib"],
        }
        for model in MODELS
    }


def measure_live(seconds: int) -> dict[str, Any]:
    """Facts that `polarnet recover` prints about a store and about lines that come in real time, by outputs."""
    generator, size = np.random.default_rng(0), dict(zip(("height", "width"), LIVE_SIZE, strict=True))
    y, x, p, k = (generator.integers(0, limit, EVENTS_PER_S) for limit in (*LIVE_SIZE, 2, 4))
    t = np.arange(EVENTS_PER_S) * 1_000_000 // EVENTS_PER_S
    tails = np.array([b" %3d %3d %d %3d\n" % row for row in zip(x, y, p, 45 * k, strict=True)])
    figures: dict[str, Any] = {**size, "events_per_s": EVENTS_PER_S, "seconds": seconds}
    with tempfile.TemporaryDirectory() as folder:
        store = EventStore.create(f"{folder}/events.zarr", ["random"], *LIVE_SIZE, {})
        second = [Events.from_columns(t[k == n], x[k == n], y[k == n], 2 * p[k == n] - 1, **size) for n in range(4)]
        file = [concatenate([shifted(one, -1_000_000 * n) for n in range(FILE_SECONDS)]) for one in second]
        store.write("random", file, 1_000_000 * FILE_SECONDS)
        store.finish()
        for name, written in (("all", ["zarr", "mp4"]), ("numbers", ["zarr"])):
            outputs = ["--write", *written, "--out", f"{folder}/{name}"]
            command = [sys.executable, "-m", "polarnet.cli", "recover", "--method", "ours", *outputs]
            of_file = subprocess.run([*command, f"{folder}/events.zarr"], capture_output=True, text=True, check=True)
            with tempfile.TemporaryFile("w+") as printed:
                live = subprocess.Popen([*command, "--live", "-"], stdin=subprocess.PIPE, stdout=printed)
                resident_mib = feed(live, tails, seconds)
                printed.seek(0)
                facts = printed.read()
            third = len(resident_mib) // 3
            figures[name] = {
                "realtime_factor": float(re.findall(r"([\d.]+) times as fast", of_file.stdout)[0]),
                "latency_ms": float(re.findall(r"([\d.]+) ms \(median\), 95", facts)[0]),
                "latency_ms_95": float(re.findall(r"95 % within ([\d.]+) ms", facts)[0]),
                "frames": re.findall(r"(?m)^(?:frames|joined) +(.+)$", facts),
                "resident_mib": {"second third": max(resident_mib[third:-third]), "last": max(resident_mib[-third:])},
            }
    return figures


def feed(live: subprocess.Popen, tails: np.ndarray, seconds: int) -> list[int]:
    """Write lines, a time and a tail each, in real time; returns the process's resident MiB at each second.

    They begin when the process uses no processor time for a second: it has started and waits for events.
    """
    assert live.stdin is not None
    resident_mib, number = [], len(tails) // CHUNKS_PER_S
    digits = 10 ** np.arange(LIVE_DIGITS)[::-1]
    live.stdin.write(b"%d %d\n" % LIVE_SIZE[::-1])
    live.stdin.flush()
    before, used = ["not yet"], ["started"]
    while used != before:
        time.sleep(1)
        before, used = used, Path(f"/proc/{live.pid}/stat").read_text().split()[13:15]
    start = time.perf_counter()
    for chunk in range(seconds * CHUNKS_PER_S):
        rows = tails[chunk % CHUNKS_PER_S * number :][:number].view(np.uint8).reshape(number, -1)
        times = chunk * 1_000_000 // CHUNKS_PER_S + np.arange(number) * 1_000_000 // len(tails)
        heads = (times[:, None] // digits % 10 + ord("0")).astype(np.uint8)
        time.sleep(max(0.0, start + (chunk + 1) / CHUNKS_PER_S - time.perf_counter()))
        live.stdin.write(np.hstack([heads, rows]).tobytes())
        if chunk % CHUNKS_PER_S == 0:
            pages = Path(f"/proc/{live.pid}/statm").read_text().split()[1]
            resident_mib.append(int(pages) * resource.getpagesize() >> 20)
    live.stdin.close()
    if live.wait():
        raise RuntimeError(f"recover ended with exit status {live.returncode}")
    return resident_mib


def main() -> None:
    """Measure, print and perhaps write."""
    parser = command_line(__doc__, "docs/results/robustness.json, emulation.json and speed.json")
    parser.add_argument("--only", choices=("network", "simulation", "live"))
    parser.add_argument("--seconds", type=int, default=60, help="of live input")
    parser.add_argument("--threads", type=int, default=usable_cores(), help="of the network")
    parser.add_argument("--before", type=Path, help="older checkout, measured in turns with this one")
    parser.add_argument("--sizes", help=argparse.SUPPRESS)
    arguments = arguments_of(parser)
    if arguments.sizes:
        print(json.dumps(measure_network(int(arguments.sizes))))
        return
    if arguments.before and arguments.only == "simulation":
        record, turns = machine_record(), measure_simulation_turns(arguments.before)
        print(json.dumps(turns, indent=1))
        if arguments.write:
            write_section("speed", "simulation_turns", turns, record)
        return
    if arguments.before:
        record, turns = machine_record(), measure_turns(arguments.before, arguments.threads)
        print(json.dumps(turns, indent=1))
        if arguments.write:
            headlines = {f"speedup_{size.replace(' ', '')}": one["speedup"] for size, one in turns["sizes"].items()}
            write_section("speed", "turns", turns, record, headlines)
        return
    studies: dict[str, tuple[str, str, Callable[[], dict[str, Any]]]] = {
        "network": ("robustness", "speed", lambda: measure_network(arguments.threads)),
        "simulation": ("emulation", "models", measure_models),
        "live": ("speed", "live", lambda: measure_live(arguments.seconds)),
    }
    for kind, (name, section, measure) in studies.items():
        if arguments.only in (None, kind):
            record = machine_record()
            figures = measure()
            print(json.dumps(figures, indent=1), flush=True)
            headlines = {}
            if kind == "live":
                factor, latency_ms = (figures["all"][key] for key in ("realtime_factor", "latency_ms_95"))
                headlines = {"realtime_factor_260x346": factor, "live_latency_ms_95": latency_ms}
            if arguments.write:
                write_section(name, section, figures, record, headlines)


if __name__ == "__main__":
    main()
