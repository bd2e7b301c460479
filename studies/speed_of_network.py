"""Speed of the shipped network: python -m studies.speed_of_network [--weights FILE] [--threads N] [--write]

For each size of sensor, windows a second on random events, many at once as in a file and one by one as from a camera,
with and without blocks of 2x2 pixels (`methods.ours.binning=2`). --write puts the figures into
docs/results/robustness.json under `speed`.
"""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from polarnet.config.tree import load
from polarnet.events.stream import Events
from polarnet.events.streaming import EventWindow, WindowCutter, WindowRule
from polarnet.methods.dolp_network import dolp_recoverer
from polarnet.networks.registry import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.runtime.machine import configure, precision_on, usable_cores
from studies.study import ROOT, arguments_of, command_line, machine_record, write_section

SIZES = ((120, 180), (260, 346), (480, 640))
RUNS, TIMED_WINDOWS, WARM_RUNS = 3, 12, 3
CPU = torch.device("cpu")
EVENTS_PER_PIXEL = 0.8  # a window; the default sensor's mean
WINDOW_US = round(1e6 / 30)


def windows_per_s(weights: Path, height: int, width: int, binning: int | None) -> dict[str, float]:
    """Windows a second of the network on random events in memory, as precise as `recover`.

    `file` takes as many at once as `recover` of a file, `camera` one after the other.
    """
    recoverer = dolp_recoverer(*load_network(weights), CPU, precision_on(CPU, "auto"), binning=binning)
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
    """Random events of four channels, as long as this number of windows."""
    generator = torch.Generator().manual_seed(0)
    count = windows * round(EVENTS_PER_PIXEL * height * width)

    def random_channel() -> Events:
        t = torch.randint(0, windows * WINDOW_US, (count,), generator=generator).sort().values
        y, x = (torch.randint(0, size, t.shape, generator=generator).short() for size in (height, width))
        p = torch.randint(0, 2, t.shape, generator=generator) * 2 - 1
        return Events(t, x, y, p.to(torch.int8), height, width)

    return [random_channel() for _ in range(4)]


def windows_of(channels: Sequence[Events], windows: int) -> list[EventWindow]:
    """The first windows of the channels, one after the other."""
    cutter = WindowCutter(WindowRule(WINDOW_US, None, None), channels[0].height, channels[0].width)
    return list(cutter.add(channels, windows * WINDOW_US))


def main() -> None:
    """Measure, print and perhaps write."""
    parser = command_line(__doc__, "docs/results/robustness.json")
    parser.add_argument("--weights", type=Path, default=shipped_weights(), help="checkpoint; default: the shipped one")
    parser.add_argument("--threads", type=int, default=usable_cores())
    arguments = arguments_of(parser)
    record = machine_record()
    config = load(ROOT, [f"runtime.threads={arguments.threads}"])
    configure(config.runtime, config.seed)
    speed: dict[str, Any] = {"threads": arguments.threads, "precision": precision_on(CPU, "auto"), "sizes": {}}
    for height, width in SIZES:
        speed["sizes"][f"{height} x {width}"] = {
            "pixels": windows_per_s(arguments.weights, height, width, None),
            "blocks": windows_per_s(arguments.weights, height, width, 2),
        }
    print(json.dumps(speed, indent=1))
    if arguments.write:
        write_section("robustness", "speed", speed, record)


if __name__ == "__main__":
    main()
