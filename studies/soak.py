"""Memory and open files over a long run: python -m studies.soak [--minutes N] [--sequences N] [--write]

Two processes, one after the other:

- live: lines of events come through a pipe without end, and the loop of `polarnet recover --live` recovers them with
  the shipped network and writes a video, for N minutes. The stream waits for the recovery, so the camera's time runs
  faster than the clock.
- sequences: short sequences are simulated, written into event stores and read again.

Each records its resident memory and its open descriptors. The first tenth is warm-up. The growth is the difference
between the medians of the last tenth and of the tenth after the warm-up. --write puts it into
docs/results/reliability.json.
"""

import dataclasses
import json
import multiprocessing
import os
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import psutil
import torch
from skimage import data

from polarnet.events.streaming import WindowRule
from polarnet.methods.dolp_network import dolp_recoverer
from polarnet.networks.registry import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.recordings.live import LiveLines, Piece, live_lines
from polarnet.recovery.stream import Input, recover
from polarnet.recovery.writer import RecoveryWriter
from polarnet.runtime.machine import tune
from polarnet.simulation import MOTIONS, SENSORS, Simulation, scene_from_rgb, simulate
from polarnet.storage.events import EventStore
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
PERIOD_S = 1.0  # the live stream repeats after this time
PER_STORE, PER_PART = 500, 100
SIZES = {"live": (32, 48), "sequences": (8, 12)}
WARM_UP = 0.1


class Meter:
    """Resident memory, MiB, and open descriptors of this process over time."""

    def __init__(self) -> None:
        self.started, self.process = time.monotonic(), psutil.Process()
        self.memory: list[float] = []
        self.descriptors: list[int] = []

    def look(self) -> None:
        """Take a sample."""
        self.memory.append(self.process.memory_info().rss / 2**20)
        self.descriptors.append(self.process.num_fds())

    def figures(self) -> dict[str, Any]:
        """Medians of the tenth after the warm-up and of the last tenth, and the growth from one to the other."""
        tenth = max(1, int(WARM_UP * len(self.memory)))
        spans = {"start": slice(tenth, 2 * tenth), "end": slice(-tenth, None)}
        memory = {name: statistics.median(self.memory[span]) for name, span in spans.items()}
        return {
            "hours": round((time.monotonic() - self.started) / 3600, 3),
            "memory_mib": {name: round(value, 1) for name, value in memory.items()},
            "growth_mib": round(memory["end"] - memory["start"], 1),
            "descriptors": {name: max(self.descriptors[span]) for name, span in spans.items()},
        }


def simulation(size: tuple[int, int], duration_s: float, seed: int) -> Simulation:
    """A small sensor that moves slowly over a photograph."""
    slow = dataclasses.replace(MOTIONS["default"], speed_min_px_s=5.0, speed_max_px_s=10.0)
    motion = dataclasses.replace(slow, sensor_height=size[0], sensor_width=size[1], duration_s=duration_s)
    return simulate(SCENE, motion, SENSORS["default"], seed)


SCENE = scene_from_rgb(torch.from_numpy(data.coffee()[::2, ::2].copy()).permute(2, 0, 1).float() / 255)


class Camera:
    """An endless stream of lines in a pipe; each period is written once the previous one has been taken."""

    def __init__(self, until: float):
        self.until, self.meter, self.events = until, Meter(), 0
        self._channels = simulation(SIZES["live"], PERIOD_S, seed=1).events
        self._taken = threading.Semaphore()
        descriptor, self._pipe = os.pipe()
        self._lines = LiveLines(self._started(descriptor), "pipe", None, idle_s=0.0)
        self.input = Input("pipe", *SIZES["live"], self._pieces(), None)

    def _started(self, descriptor: int) -> Any:
        threading.Thread(target=self._send, daemon=True).start()
        return os.fdopen(descriptor, "rb")

    def _send(self) -> None:
        period_us, number = round(PERIOD_S * 1e6), 0
        with os.fdopen(self._pipe, "wb") as pipe:
            while time.monotonic() < self.until:
                self._taken.acquire()
                shifted = [dataclasses.replace(one, t=one.t + number * period_us) for one in self._channels]
                head, times, lines = live_lines(shifted)
                self.events += len(times)
                pipe.write(lines if number else head + lines)
                pipe.flush()
                number += 1

    def _pieces(self) -> Iterator[Piece]:
        sent = 0
        for piece in self._lines:
            yield piece
            if self.events > sent:
                sent = self.events
                self.meter.look()
                self._taken.release()


def live(minutes: float, sequences: int) -> dict[str, Any]:
    """Recovery of an endless stream for some minutes."""
    network, metadata = load_network(shipped_weights())
    camera = Camera(time.monotonic() + 60 * minutes)
    with tempfile.TemporaryDirectory() as folder:
        writer = RecoveryWriter(Path(folder), ["mp4"], 30.0)
        recoverer = dolp_recoverer(network, metadata, torch.device("cpu"), "fp32")
        summary = recover(camera.input, WindowRule(33_333, None, None), recoverer, writer)
    about = {"events": camera.events, "camera_hours": round(summary.stream_s / 3600, 3), "sequences": None}
    return {**about, **camera.meter.figures()}


def sequences(minutes: float, sequences: int) -> dict[str, Any]:
    """Simulation, storage and reading of many short sequences."""
    meter, events = Meter(), 0
    for first in range(0, sequences, PER_STORE):
        names = [f"{number:06d}" for number in range(first, min(first + PER_STORE, sequences))]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "events.zarr")
            store = EventStore.create(path, names, *SIZES["sequences"], {}, PER_PART)
            written = 0
            for name in names:
                simulated = simulation(SIZES["sequences"], 0.1, seed=int(name))
                store.write(name, simulated.events, int(simulated.t_us[-1]))
                written += sum(map(len, simulated.events))
            store.finish()
            store = EventStore.open(path)
            for name in names:
                events += sum(map(len, store.read(name)))
                meter.look() if int(name) % 20 == 0 else None
    return {"events": events, "camera_hours": None, "sequences": sequences, **meter.figures()}


def alone(phase: Any, *arguments: Any) -> dict[str, Any]:
    """Figures of a phase in a process of its own, on one thread."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_start) as pool:
        return pool.submit(phase, *arguments).result()


def _start() -> None:
    tune()
    torch.set_num_threads(1)


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/reliability.json")
    parser.add_argument("--minutes", type=float, default=60.0, help="length of the live recovery")
    parser.add_argument("--sequences", type=int, default=10_000)
    arguments = arguments_of(parser)
    record = machine_record(ROOT)
    phases = {phase.__name__: alone(phase, arguments.minutes, arguments.sequences) for phase in (live, sequences)}
    print(json.dumps(phases, indent=2))
    if arguments.write:
        headlines = {
            "soak_memory_growth_mib": max(phase["growth_mib"] for phase in phases.values()),
            "soak_hours": round(sum(phase["hours"] for phase in phases.values()), 3),
        }
        print(write_section(ROOT, "reliability", "soak", phases, record, headlines))


if __name__ == "__main__":
    main()
