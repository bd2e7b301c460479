"""Speed of training and inference: python -m studies.training [--write] [--rounds N] [--device cuda]

Rates are in frames a second, of four channels of 120 x 180 pixels. Training is a forward and backward pass through
batches of sequences, with the squared outputs as loss, without optimizer and data loading. Inference is one stream
with its state. Weights and inputs are random. Every network of `params.yaml` with a class of its own is measured in
these settings:

- `naive`: float32, contiguous NCHW images, one window at a time, torch's default settings;
- `shipped`: channels_last, several windows at once, `train.precision` auto; training with the settings of
  `polarnet.runtime.machine.configure`, as in the stages; inference with as many windows as `polarnet recover` takes
  from a file;
- `compiled` (with --compile): `shipped` with torch.compile, which needs a C++ compiler; networks for which it fails
  have no such row.

Each measurement has its own process; they take turns, and figures are medians over the turns. `peak_gflop_per_s` is
the rate of a matrix product with the same threads and precision. The profile is that of the last turn.

`--write` merges the figures into docs/results/network.json: the section `throughput` and the headline figures
`train_speedup_over_eager_fp32` and `infer_windows_per_s` of `paper`, and `ours.infer_windows_per_s` of `polarnet`; on
a GPU the section alone, as `throughput_cuda`.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from polarnet.config.tree import load
from polarnet.events.representations import REPRESENTATIONS, channels_of
from polarnet.methods.method import windows_at_once
from polarnet.networks.registry import NETWORKS
from polarnet.runtime.machine import configure, device_of, limit_threads, precision_on, usable_cores
from polarnet.stokes import Prediction
from polarnet.training.engine.loop import autocast
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
HEIGHT, WIDTH = 120, 180
BATCH, RUN = 2, 5  # sequences and windows of a training step
STREAMED = 20  # windows of an inference
REPEATS = 3  # in a process, after one that is not timed
MATRIX = 1024  # rows of the product that measures the peak
OPERATIONS = 12  # of the profile
SETTINGS = ("naive", "shipped", "compiled")
MEASURED = ("train_frames_per_s", "infer_windows_per_s")


def network_of(name: str, setting: str, device: torch.device) -> tuple[nn.Module, int]:
    """The network with random weights under a setting, and its input channels."""
    config = load(ROOT)
    settings = getattr(config.networks, name)
    build = settings.network_class
    channels = 4 * channels_of(REPRESENTATIONS[build.representation])
    torch.manual_seed(0)
    network = build(settings, channels).to(device)
    if setting == "naive":
        for module in network.modules():
            if isinstance(module, nn.Conv2d):
                module.register_forward_pre_hook(lambda _, inputs: (inputs[0].contiguous(),))
    else:
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network, channels


def loss_of(prediction: Prediction) -> Tensor:
    """A loss that depends on every output."""
    return torch.stack([output.square().mean() for output in prediction if output is not None]).sum()


def measure_one(name: str, setting: str, threads: int, device_name: str) -> dict[str, Any]:
    """Figures of one network under one setting, in this process."""
    runtime = replace(load(ROOT).runtime, device=device_name, threads=threads)
    device = device_of(runtime)
    limit_threads(threads)
    if setting != "naive":
        configure(runtime, seed=0)
    precision = "fp32" if setting == "naive" else precision_on(device, "auto")
    network, channels = network_of(name, setting, device)
    windows = torch.randn(RUN, BATCH, channels, HEIGHT, WIDTH, device=device)
    stream = torch.randn(STREAMED, 1, channels, HEIGHT, WIDTH, device=device)
    steps: Any = network  # every network has `unroll`, which nn.Module does not declare
    unroll = torch.compile(steps.unroll) if setting == "compiled" else steps.unroll

    def train() -> None:
        network.zero_grad()
        state, loss = None, torch.zeros((), device=device)
        for run in windows.split(1) if setting == "naive" else [windows]:
            with autocast(precision, device):
                prediction, state = unroll(run, state)
                loss = loss + loss_of(prediction)
        loss.backward()

    at_once = 1 if setting == "naive" else windows_at_once(HEIGHT, WIDTH)

    @torch.inference_mode()
    def infer() -> None:
        state = None
        for run in stream.split(at_once):
            with autocast(precision, device):
                _, state = unroll(run, state)

    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(stream[0])
    figures: dict[str, Any] = {"precision": precision, "gflop_per_window": round(counter.get_total_flops() / 1e9, 2)}
    network.train()
    figures["train_frames_per_s"] = RUN * BATCH / seconds_of(train, device)
    figures["train_profile"] = profile_of(train)
    network.eval()
    torch.use_deterministic_algorithms(False)  # which `configure` asks for, and `recover` does not
    figures["infer_windows_per_s"] = STREAMED / seconds_of(infer, device)
    figures["infer_profile"] = profile_of(infer)
    figures["peak_gflop_per_s"] = peak_gflop_per_s(precision, device)
    return figures


def seconds_of(run: Callable[[], object], device: torch.device) -> float:
    """Median of the repeats, the first call left out."""
    seconds = []
    for _ in range(1 + REPEATS):
        start = time.perf_counter()
        run()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:])


def profile_of(run: Callable[[], None]) -> dict[str, float]:
    """Percent of the time in each of torch's operations, the longest first."""
    with torch.profiler.profile() as profiler:
        run()
    times: dict[str, float] = {}
    for row in profiler.key_averages():
        name = "compiled graphs" if "CompiledFxGraph" in row.key else row.key
        times[name] = times.get(name, 0.0) + (row.self_device_time_total or row.self_cpu_time_total)
    total = sum(times.values())
    longest = sorted(times, key=lambda name: -times[name])[:OPERATIONS]
    return {name: round(100 * times[name] / total, 1) for name in longest}


def peak_gflop_per_s(precision: str, device: torch.device) -> float:
    """Rate of a product of large matrices in this precision, in GFLOP/s."""
    dtype = torch.bfloat16 if precision == "bf16" else torch.float32
    a, b = torch.randn(2, MATRIX, MATRIX, dtype=dtype, device=device)
    return 2 * MATRIX**3 / seconds_of(lambda: torch.mm(a, b), device) / 1e9


def in_own_process(name: str, setting: str, threads: int, device: str) -> dict[str, Any]:
    """`measure_one` in a new process of this script."""
    command = [
        sys.executable,
        "-m",
        "studies.training",
        "--one",
        name,
        setting,
        "--threads",
        str(threads),
        "--device",
        device,
    ]
    return json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()[-1])


def measure(names: list[str], settings: list[str], rounds: int, threads: int, device: str) -> dict[str, Any]:
    """The section `throughput`, printed as it comes."""
    processor = torch.cuda.get_device_name(device) if torch.device(device).type == "cuda" else device
    figures: dict[str, Any] = {
        "threads": threads, "device": processor, "rounds": rounds, "height": HEIGHT, "width": WIDTH, "batch": BATCH,
        "run_windows": RUN, "networks": {},
    }  # fmt: skip
    for name in names:
        turns: dict[str, list[dict[str, Any]]] = {setting: [] for setting in settings}
        for _ in range(rounds):
            for setting in list(turns):
                try:
                    one = in_own_process(name, setting, threads, device)
                except subprocess.CalledProcessError:
                    if setting != "compiled":
                        raise
                    print(f"{name:10s} left out: torch.compile failed, see above", flush=True)
                    del turns[setting]
                    continue
                turns[setting].append(one)
                print(f"{name:10s} {setting:9s}", *(f"{key} {one[key]:.2f}" for key in MEASURED), flush=True)
        rows = {}
        for setting, runs in turns.items():
            medians = {key: statistics.median(run[key] for run in runs) for key in (*MEASURED, "peak_gflop_per_s")}
            rows[setting] = runs[-1] | {key: round(value, 2) for key, value in medians.items()}
        faster = {key: round(rows["shipped"][key] / rows["naive"][key], 2) for key in MEASURED}
        figures["networks"][name] = {**rows, "shipped_over_naive": faster}
        print(f"{name:10s} shipped over naive: {faster}")
    return figures


def headlines(networks: dict[str, Any]) -> dict[str, Any]:
    """The figures of docs/results/network.json that stand above its sections."""
    figures: dict[str, Any] = {}
    if "paper" in networks:
        figures["train_speedup_over_eager_fp32"] = networks["paper"]["shipped_over_naive"]["train_frames_per_s"]
        figures["infer_windows_per_s"] = networks["paper"]["shipped"]["infer_windows_per_s"]
    if "polarnet" in networks:
        figures["ours"] = {"infer_windows_per_s": networks["polarnet"]["shipped"]["infer_windows_per_s"]}
    return figures


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/network.json")
    parser.add_argument("--rounds", type=int, default=3, help="turns of every setting")
    parser.add_argument("--threads", type=int, default=usable_cores())
    parser.add_argument("--device", default="cpu", help="cpu, cuda or cuda:N")
    parser.add_argument("--compile", action="store_true", help="measure torch.compile as well")
    parser.add_argument("--networks", nargs="+", choices=list(NETWORKS), default=list(NETWORKS))
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    arguments = arguments_of(parser)
    if arguments.one:
        name, setting = arguments.one
        print(json.dumps(measure_one(name, setting, arguments.threads, arguments.device)))
        return
    record = machine_record(ROOT)
    print(f"{record['machine']}, {record['cores']} cores, load {record['load']}")
    settings = list(SETTINGS if arguments.compile else SETTINGS[:2])
    figures = measure(arguments.networks, settings, arguments.rounds, arguments.threads, arguments.device)
    if arguments.write:
        kind = torch.device(arguments.device).type
        section, above = ("throughput", headlines(figures["networks"])) if kind == "cpu" else (f"throughput_{kind}", {})
        path = write_section(ROOT, "network", section, figures, record, above)
        print(f"written to {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
