"""Speed of the network, the emulator and recovery: python -m studies.speed [--only NAME ...] [--write]

- network: windows a second on random points that move, for each size of sensor, many at once as in a file and one by
  one as from a camera, with and without blocks of 2x2 pixels (`methods.ours.binning=2`). --write:
  docs/results/robustness.json, section speed.
- turns, with --before CHECKOUT: `measure_network` of an older checkout, in turns with this one's, and
  ratios of the medians. --write: docs/results/speed.json, section turns, and speedup_HEIGHTxWIDTH of files and cameras.
- simulation: events of one drifting sensor (`studies.simulation_run`). Times are medians of wall-clock time. Every
  model and number of threads runs in its own process; the processes take turns, so that other load affects all of them
  alike. --write: docs/results/emulation.json.
- live: `polarnet recover` of a million random events a second, with every output and with numbers alone, on 260 x 346
  pixels behind each polarizer, and on the 130 x 173 of a PDAVIS. From a store: how many times as fast as real time.
  `--live`, `--seconds` (60) of lines through a pipe: latency, joined windows, and memory in the second and the last
  third of the time. --write: docs/results/speed.json.
"""

import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polarnet.config.tree import load
from polarnet.events.stream import Events, concatenate, shifted
from polarnet.events.streaming import EventWindow, WindowCutter, WindowRule
from polarnet.methods.dolp_network import dolp_recoverer
from polarnet.networks.registry import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.reports.artefacts import git
from polarnet.runtime.machine import configure, precision_on, usable_cores
from polarnet.storage.events import EventStore
from studies.simulation_run import timed_run
from studies.study import ROOT, Measurement, command_line, in_own_process, measure_sections

SIZES = ((120, 180), (260, 346), (480, 640))
RUNS, TIMED_WINDOWS, WARM_RUNS = 3, 12, 3
KINDS = ("file", "camera")
CPU = torch.device("cpu")
SHIFT = 2  # pixels per window of the points, whose motion the network finds
EVENTS_PER_PIXEL = 0.8  # a window; the default sensor's mean
WINDOW_US = round(1e6 / 30)
MODELS = ("v2e", "exact", "esim", "dvs_voltmeter")
THREADS = (1, 2)
LIVE_SIZES, OUTPUTS = ((260, 346), (130, 173)), {"all": ("zarr", "mp4"), "numbers": ("zarr",)}
EVENTS_PER_S, CHUNKS_PER_S, FILE_SECONDS, LIVE_DIGITS = 1_000_000, 100, 10, 10
ROUNDS = 3  # processes of each checkout, of each model and number of threads


def windows_per_s(height: int, width: int, binning: int | None) -> dict[str, float]:
    """Windows a second of the network on random points that move, in memory, as precise as `recover`.

    `file` takes as many at once as `recover` of a file, `camera` one after the other.
    """
    recoverer = dolp_recoverer(*load_network(shipped_weights()), CPU, precision_on(CPU, "auto"), binning=binning)
    rates = {}
    for name, size, runs in (("file", recoverer.at_once(height, width), RUNS), ("camera", 1, TIMED_WINDOWS)):
        count = size * (WARM_RUNS + runs)
        windows = random_windows(height, width, count)
        state = recoverer.start(height, width)
        for number in range(WARM_RUNS + runs):
            if number == WARM_RUNS:
                start = time.perf_counter()
            state, _ = recoverer.step(state, windows[number * size : (number + 1) * size])
        rates[name] = round(size * runs / (time.perf_counter() - start), 2)
    return rates


def random_windows(height: int, width: int, windows: int) -> list[EventWindow]:
    """Windows of four channels, one after the other: random points that move to the right."""
    generator = np.random.default_rng(0)
    count = round(EVENTS_PER_PIXEL * height * width)
    number = np.repeat(np.arange(windows), count)

    def random_channel() -> Events:
        t = WINDOW_US * number + np.sort(generator.integers(0, WINDOW_US, (windows, count))).ravel()
        y, x = (np.tile(generator.integers(0, size, count), windows) for size in (height, width))
        p = np.tile(generator.choice([-1, 1], count), windows)
        return Events.from_columns(t, (x + SHIFT * number) % width, y, p, height, width)

    cutter = WindowCutter(WindowRule(WINDOW_US, None), height, width)
    return list(cutter.add([random_channel() for _ in range(4)], windows * WINDOW_US))


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


def measure_turns(before: Path, threads: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Medians of windows a second of the checkout `before` and of this one, and their ratios; the latter by size.

    The network of each runs in processes of its own, in turns; each checkout goes first in every other round.
    """
    turns: dict[Path, list[dict[str, Any]]] = {before: [], ROOT: []}
    for number in range(ROUNDS):
        for root in list(turns)[:: (-1) ** number]:
            turns[root].append(in_own_process(measure_network, threads, root=root)["sizes"])

    def medians(root: Path, size: str) -> dict[str, float]:
        return {kind: float(np.median([sizes[size]["pixels"][kind] for sizes in turns[root]])) for kind in KINDS}

    figures = {}
    for size in turns[ROOT][0]:
        old, new = medians(before, size), medians(ROOT, size)
        speedup = {kind: round(new[kind] / old[kind], 2) for kind in KINDS}
        figures[size] = {"before": old, "now": new, "speedup": speedup}
    headlines = {f"speedup_{size.replace(' ', '')}": one["speedup"] for size, one in figures.items()}
    return {"threads": threads, "commit_before": git(before, "rev-parse", "HEAD"), "sizes": figures}, headlines


def measure_models() -> dict[str, dict[str, Any]]:
    """Seconds on one and two threads, rate of events and peak memory by model."""
    runs: dict[tuple[str, int], list[dict[str, Any]]] = {(model, t): [] for model in MODELS for t in THREADS}
    for _ in range(ROUNDS):
        for model, threads in runs:
            runs[model, threads].append(in_own_process(timed_run, model, threads))
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


def measure_live(seconds: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Facts that `polarnet recover` prints about a store and about lines that come in real time, by size and outputs.

    Headlines are those with every output.
    """
    sizes = {f"{height} x {width}": measure_live_size(seconds, height, width) for height, width in LIVE_SIZES}
    (height, width), *_ = LIVE_SIZES
    factors = {f"realtime_factor_{height}x{width}": sizes[f"{height} x {width}"]["all"]["realtime_factor"]}
    latencies = [of_size["all"]["latency_ms_95"] for of_size in sizes.values()]
    headlines = factors | {"live_latency_ms_95": latencies[0], "live_latency_ms_95_pdavis": latencies[1]}
    return {"events_per_s": EVENTS_PER_S, "seconds": seconds, "sizes": sizes}, headlines


def measure_live_size(seconds: int, height: int, width: int) -> dict[str, Any]:
    """The same of one size of the four channels."""
    generator, figures = np.random.default_rng(0), {}
    y, x, p, k = (generator.integers(0, limit, EVENTS_PER_S) for limit in (height, width, 2, 4))
    t = np.arange(EVENTS_PER_S) * 1_000_000 // EVENTS_PER_S
    tails = np.array([b" %3d %3d %d %3d\n" % row for row in zip(x, y, p, 45 * k, strict=True)])
    with tempfile.TemporaryDirectory() as folder:
        store = EventStore.create(f"{folder}/events.zarr", ["random"], height, width, {})
        columns = [(t[k == n], x[k == n], y[k == n], 2 * p[k == n] - 1) for n in range(4)]
        second = [Events.from_columns(*of_channel, height=height, width=width) for of_channel in columns]
        file = [concatenate([shifted(one, -1_000_000 * n) for n in range(FILE_SECONDS)]) for one in second]
        store.write("random", file, 1_000_000 * FILE_SECONDS)
        store.finish()
        for name, written in OUTPUTS.items():
            outputs = ["--write", *written, "--out", f"{folder}/{name}"]
            command = [sys.executable, "-m", "polarnet.cli", "recover", "--method", "ours", *outputs]
            of_file = subprocess.run([*command, f"{folder}/events.zarr"], capture_output=True, text=True, check=True)
            with tempfile.TemporaryFile("w+") as printed:
                live = subprocess.Popen([*command, "--live", "-"], stdin=subprocess.PIPE, stdout=printed)
                resident_mib = feed(live, (height, width), tails, seconds)
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


def feed(live: subprocess.Popen, size: tuple[int, int], tails: np.ndarray, seconds: int) -> list[int]:
    """Write lines, a time and a tail each, in real time; returns the process's resident MiB at each second.

    They begin when the process uses no processor time for a second: it has started and waits for events.
    """
    assert live.stdin is not None
    resident_mib, number = [], len(tails) // CHUNKS_PER_S
    digits = 10 ** np.arange(LIVE_DIGITS)[::-1]
    live.stdin.write(b"%d %d\n" % size[::-1])
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
    parser.add_argument("--seconds", type=int, default=60, help="of live input")
    parser.add_argument("--threads", type=int, default=usable_cores(), help="of the network")
    parser.add_argument("--before", type=Path, default=ROOT, help="older checkout for turns")
    sections: dict[str, tuple[str, str, Measurement]] = {
        "network": ("robustness", "speed", lambda given: (measure_network(given.threads), {})),
        "simulation": ("emulation", "models", lambda _: (measure_models(), {})),
        "live": ("speed", "live", lambda given: measure_live(given.seconds)),
        "turns": ("speed", "turns", lambda given: measure_turns(given.before, given.threads)),
    }
    measure_sections(parser, sections, default=("network", "simulation", "live"))


if __name__ == "__main__":
    main()
