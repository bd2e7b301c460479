"""Speed of `polarnet recover`: python -m studies.recover
    [--write] [--weights FILE] [--precision auto|fp32|bf16] [--picture FILE]

A sensor of 120 x 180 pixels behind four polarizers moves over a photograph of scikit-image, on a clock stretched to 1
M events a second. The events are recovered as the command does it: windows of 1/30 s, frames written as Zarr, PNG and
video. `realtime_factor` is the length of the stream divided by the time of the run, writing included; above 1 the run
is faster than the camera. `latency_ms` is the median time of a step for windows that arrive one by one, from events in
memory to DoLP and AoLP in memory. Methods are the network and the high-pass filter with and without solved gains. The
network is that of --weights, else the shipped one, else an untrained one of params.yaml, which costs the same. It also
recovers a stream of 260 x 346 pixels and as many events, with and without blocks of 2x2 pixels. In the live
measurement, another process sends the stream through a pipe at its own pace; its latency runs from the arrival of an
event to the frame that contains it.

`--write` merges the figures into docs/results/recordings.json under `recover`. `--picture` copies the network's
pictures of the stream, or those of the high-pass filter if the network is untrained.
"""

import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, BinaryIO, cast

import torch
from skimage import data

from polarnet.config.pipeline import setup_of
from polarnet.config.tree import Config, load
from polarnet.events.representations import REPRESENTATIONS, channels_of
from polarnet.events.stream import Events
from polarnet.events.streaming import WindowRule
from polarnet.methods import METHODS
from polarnet.methods.dolp_network import dolp_recoverer
from polarnet.methods.method import Recoverer
from polarnet.networks.registry import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.recordings.arrangements import write_store
from polarnet.recordings.live import LiveLines, Piece
from polarnet.recovery.stream import Input, Summary, frames_of, recover
from polarnet.recovery.writer import RecoveryWriter
from polarnet.runtime.machine import precision_on, tune
from polarnet.simulation import simulate
from studies.measure import arguments_of, command_line, machine_record

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results" / "recordings.json"
RATE = 1_000_000  # events a second of the four polarizers together
WINDOWS = WindowRule(33_333, None, None)
WRITTEN = ("zarr", "png", "mp4")
UNTRAINED = ", untrained"
FILTERS = ("highpass", "highpass+gain")
SMALL, LARGE = (120, 180), (260, 346)
ON_LARGE: dict[str, int | None] = {"network, 260x346": None, "network, 260x346, 2x2 blocks": 2}
"""Binning of the network on the large sensor."""
CPU = torch.device("cpu")


def stream_of_events(config: Config, seconds: float, size: tuple[int, int]) -> list[Events]:
    """Four channels of a sensor of this size, `seconds` long, at `RATE`."""
    picture = torch.from_numpy(data.coffee()).permute(2, 0, 1).float() / 255
    motion = replace(config.synthesize, duration_s=seconds, sensor_height=size[0], sensor_width=size[1])
    channels = simulate(picture, motion, config.emulate, seed=1).events
    stretch = sum(map(len, channels)) / (RATE * seconds)
    stretched = [replace(events, t=(events.t * stretch).long()) for events in channels]
    return [replace(e, **{c: getattr(e, c)[e.t < seconds * 1e6] for c in "txyp"}) for e in stretched]


def network_of(
    config: Config, weights: Path | None, precision: str, binning: int | None = None
) -> tuple[Recoverer, str]:
    """The network to measure, and what it is."""
    try:
        weights = weights or shipped_weights()
    except FileNotFoundError:
        build = config.network_config.network_class
        representation = config.train.representation or build.representation
        torch.manual_seed(config.seed)
        module = build(config.network_config, 4 * channels_of(REPRESENTATIONS[representation]))
        metadata: Any = {"network": config.network, "representation": representation}
        return dolp_recoverer(module, metadata, CPU, precision, binning=binning), config.network + UNTRAINED
    network, metadata = load_network(weights)
    return dolp_recoverer(network, metadata, CPU, precision, binning=binning), metadata["network"]


def latency_ms(channels: Sequence[Events], recoverer: Recoverer) -> float:
    """The median of a step when windows come one by one."""
    source = Input("stream", channels[0].height, channels[0].width, [piece_of(channels)], None)
    return 1000 * statistics.median(frame.step_s for frame in frames_of(source, WINDOWS, recoverer, at_once=1))


def piece_of(channels: Sequence[Events]) -> Piece:
    """All events at once."""
    return Piece(channels, max(int(events.t[-1]) for events in channels) + 1, time.perf_counter())


def measured(channels: Sequence[Events], recoverer: Recoverer, out: Path) -> tuple[Summary, Path]:
    """A run of the command's own loop over events in memory, and the pictures it left."""
    piece = piece_of(channels)
    source = Input("stream", channels[0].height, channels[0].width, [piece], piece.until_us)
    writer = RecoveryWriter(out, WRITTEN, 30.0)
    summary = recover(source, WINDOWS, recoverer, writer)
    writer.write_page("stream", {}, [])
    return summary, out / "recovered.png"


def measured_live(store: Path, recoverer: Recoverer, out: Path) -> Summary:
    """The same, as lines come through a pipe from another process at their own pace."""
    command = [sys.executable, "-m", "polarnet.cli", "replay", str(store), "stream"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as camera:
        assert camera.stdout is not None
        lines = LiveLines(cast(BinaryIO, camera.stdout), "pipe", None, idle_s=0.0)
        source = Input("pipe", lines.height, lines.width, lines, None)
        return recover(source, WINDOWS, recoverer, RecoveryWriter(out, ("zarr", "mp4"), 30.0))


def figures_of(summary: Summary, step_ms: float) -> dict[str, float]:
    """Figures of a run, and of a step whose windows arrive one by one."""
    return {"realtime_factor": round(summary.realtime_factor, 3), "latency_ms": round(step_ms, 2)}


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/recordings.json")
    parser.add_argument("--weights", type=Path, help="checkpoint of the network")
    parser.add_argument(
        "--precision", choices=("auto", "fp32", "bf16"), default="auto", help="number format of the network"
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the stream in seconds")
    parser.add_argument("--picture", type=Path, help="file for the pictures of a run")
    arguments = arguments_of(parser)
    config = load(ROOT)
    tune()
    figures: dict[str, Any] = machine_record(ROOT)
    channels, large = (stream_of_events(config, arguments.seconds, size) for size in (SMALL, LARGE))
    precision = precision_on(CPU, arguments.precision)
    network, name = network_of(config, arguments.weights, precision)
    recoverers = {"network": network}
    for name_of_filter in FILTERS:
        method = METHODS[name_of_filter]
        recoverers[name_of_filter] = method.open(replace(setup_of(config, method), device=CPU))
    count = sum(map(len, channels))
    figures |= {"network": name, "precision": precision, "events": count, "seconds": arguments.seconds, "methods": {}}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        pictures = {}
        for key, recoverer in recoverers.items():
            summary, pictures[key] = measured(channels, recoverer, folder / key)
            figures["methods"][key] = figures_of(summary, latency_ms(channels, recoverer))
            print(key, asdict(summary), flush=True)
        for key, binning in ON_LARGE.items():
            network, _ = network_of(config, arguments.weights, precision, binning)
            summary, _ = measured(large, network, folder / key)
            figures["methods"][key] = figures_of(summary, latency_ms(large, network))
            print(key, asdict(summary), flush=True)
        write_store(folder / "events.zarr", {"stream": channels})
        for key in ("network", "highpass"):
            summary = measured_live(folder / "events.zarr", recoverers[key], folder / f"{key}_live")
            figures["methods"][key]["live_latency_ms"] = round(summary.latency_ms or 0.0, 1)
            print(f"{key}, live", asdict(summary), flush=True)
        if arguments.picture:
            shutil.copy(pictures["highpass" if name.endswith(UNTRAINED) else "network"], arguments.picture)
    figures |= figures["methods"]["network"]
    print(json.dumps(figures, indent=2))
    if arguments.write:
        known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        RESULTS.parent.mkdir(parents=True, exist_ok=True)
        RESULTS.write_text(json.dumps(known | {"recover": figures}, indent=2) + "\n")
        print(f"written to {RESULTS.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
