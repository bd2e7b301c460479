"""Cost and accuracy of LPIPS: python -m studies.lpips [--rounds N] [--write]

- Errors: the largest difference from the values in tests/golden/lpips.json, by the programs that the weights come from.
- Scoring: milliseconds for one frame of one method, 120 x 180 pixels, in float32 as the benchmark scores; the truth's
  features are computed beforehand, once for all methods.
- Training: milliseconds of a step of `params.yaml`'s network at its size, with LPIPS on each backbone and without, and
  LPIPS's share of the step; the same of `experiment=paper`. Weights and inputs are random; settings take turns, and the
  figures are medians over the rounds.

`--write` puts the figures into docs/results/lpips.json, with the rows of docs/results/pipeline.json that have LPIPS and
the points of docs/results/sweep.json.
"""

import json
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import skimage.data
import torch
from torch import Tensor

from polarnet.benchmark.score import FRAMES_AT_ONCE
from polarnet.config.tree import Config, load
from polarnet.events.representations import channels_of
from polarnet.metrics.lpips import BACKBONES, Lpips
from polarnet.metrics.lpips_weights import find_weights
from polarnet.runtime.machine import configure, device_of, precision_on, usable_cores
from polarnet.training.dolp import dolp_task
from polarnet.training.engine.loop import train_batch
from polarnet.training.engine.optimizers import OPTIMIZERS
from polarnet.training.engine.sequences import Batch
from studies.measure import arguments_of, command_line, machine_record, read_results, write_section

ROOT = Path(__file__).resolve().parents[1]
HEIGHT, WIDTH = 120, 180
WITHOUT = "none"


def networks() -> dict[str, Lpips]:
    """LPIPS on every backbone."""
    return {backbone: Lpips.of(backbone, find_weights(backbone, None).tensors) for backbone in BACKBONES}


def largest_error(lpips: Lpips) -> float:
    """Largest difference from the values of tests/golden/lpips.json."""
    golden = json.loads((ROOT / "tests" / "golden" / "lpips.json").read_text())
    top, bottom, left, right = golden["crop"]
    sharp = skimage.data.astronaut()[top:bottom, left:right] / np.float32(255)
    errors = []
    for blur, expected in golden["distances"][lpips.backbone].items():
        pair = [torch.from_numpy(x).permute(2, 0, 1)[None] for x in (sharp, cv2.blur(sharp, (int(blur), int(blur))))]
        errors.append(abs(lpips(*pair).item() - expected))
    return max(errors)


def scoring(lpips: Lpips, device: torch.device) -> Callable[[], None]:
    """Score as many frames as the benchmark takes at once."""
    lpips, frames = lpips.to(device), torch.rand(FRAMES_AT_ONCE, HEIGHT, WIDTH, device=device)
    with torch.no_grad():
        of_truth = lpips.features(1 - frames)

    @torch.no_grad()
    def run() -> None:
        lpips.distance(lpips.features(frames), of_truth)

    return run


def training(config: Config, lpips: Lpips | None, windows: int, device: torch.device) -> Callable[[], None]:
    """A step of the configured network on random events: forward, backward, optimizer."""
    loss = config.loss if lpips else replace(config.loss, lpips=0.0)
    lpips = lpips and lpips.to(device)
    task = dolp_task(config.network, config.network_config, config.train, loss, lpips, config.seed)
    network = task.network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = OPTIMIZERS[task.optimizer](network, config.train.learning_rate)
    frames = (windows, config.train.batch_size, HEIGHT, WIDTH)
    events: Tensor = torch.randn(*frames[:2], 4 * channels_of(task.encode), *frames[2:])
    names = [str(number) for number in range(config.train.batch_size)]
    batch = Batch(names, events, torch.rand(frames), torch.rand(frames), torch.rand(*frames[:2], 0, *frames[2:]))

    def run() -> None:
        train_batch(task, optimizer, batch, config.train, device)

    return run


def milliseconds(runs: Mapping[str, Callable[[], None]], rounds: int, device: torch.device) -> dict[str, float]:
    """Median time of each run, which take turns; the first round does not count."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(1 + rounds):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            times[name].append(1000 * (time.perf_counter() - start))
    return {name: round(statistics.median(values[1:]), 2) for name, values in times.items()}


def share_of(step_ms: Mapping[str, float]) -> dict[str, float]:
    """LPIPS's share of a training step, for each backbone."""
    return {name: round(1 - step_ms[WITHOUT] / value, 3) for name, value in step_ms.items() if name != WITHOUT}


def measure(found: Mapping[str, Lpips], rounds: int, threads: int, device_name: str) -> tuple[dict, dict]:
    """Section `cost` and the headlines of docs/results/lpips.json."""
    demo, paper = load(ROOT), load(ROOT, ["experiment=paper"])
    runtime = replace(demo.runtime, threads=threads, device=device_name)
    configure(runtime, seed=0)
    device = device_of(runtime)
    errors = {f"{backbone}_error_max": largest_error(lpips) for backbone, lpips in found.items()}
    scored = milliseconds({name: scoring(lpips, device) for name, lpips in found.items()}, rounds, device)
    per_frame = {name: round(value / FRAMES_AT_ONCE, 2) for name, value in scored.items()}
    print(json.dumps(errors), json.dumps(per_frame), flush=True)
    cost: dict[str, Any] = {"threads": threads, "device": device_name, "height": HEIGHT, "width": WIDTH}
    setups = {"demo": (demo, found), "paper": (paper, {"vgg": found["vgg"]})}
    for name, (config, lpips_of) in setups.items():
        windows = config.train.bptt_windows
        runs = {WITHOUT: training(config, None, windows, device)}
        runs |= {backbone: training(config, lpips, windows, device) for backbone, lpips in lpips_of.items()}
        step_ms = milliseconds(runs, rounds, device)
        cost[name] = {
            "network": config.network,
            "precision": precision_on(device, config.train.precision),
            "frames": windows * config.train.batch_size,
            "step_ms": step_ms,
            "share": share_of(step_ms),
        }
        print(name, json.dumps(cost[name]), flush=True)
    headlines = {**errors, "scoring_ms_per_frame": per_frame, "training_share": cost["demo"]["share"]}
    return cost, headlines | {"paper_step_ms": cost["paper"]["step_ms"]["vgg"]}


def elsewhere() -> dict[str, int]:
    """How many rows of the demo's table have LPIPS, and how many points the sweep over the loss has."""
    rows = read_results(ROOT, "pipeline").get("metrics", {}).values()
    sweep = read_results(ROOT, "sweep")
    counted = {"demo_rows_with_lpips": sum(row.get("lpips") is not None for row in rows)}
    return counted | ({"sweep_points": len(sweep["points"])} if "points" in sweep else {})


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/lpips.json")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=usable_cores())
    parser.add_argument("--device", default="cpu", help="cpu, cuda or cuda:N")
    arguments = arguments_of(parser)
    record = machine_record(ROOT)
    print(f"{record['machine']}, {record['cores']} cores, load {record['load']}")
    cost, headlines = measure(networks(), arguments.rounds, arguments.threads, arguments.device)
    headlines |= elsewhere()
    print(json.dumps(headlines, indent=2))
    if arguments.write:
        print(f"written to {write_section(ROOT, 'lpips', 'cost', cost, record, headlines).relative_to(ROOT)}")


if __name__ == "__main__":
    main()
