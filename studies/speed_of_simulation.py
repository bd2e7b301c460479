"""Speed and accuracy of the emulator: python -m studies.speed_of_simulation [--write] [--paper-set N]

A sensor of 120 x 180 pixels drifts over the coffee photograph at 110 px/s for a second: 300 steps, four channels. Times
run from rendering to columns in memory and are medians of wall-clock time with compiled kernels. Every model and number
of threads runs in its own process; the processes take turns, so that other load affects all of them alike. Timing
errors are those of noiseless pixels relative to `exact` at 4800 steps a second, where all polarities agree.

The paper's set is made by ingest, synthesize and emulate with experiment=paper on two workers; `--paper-set N` makes
about N sequences instead of 1000. `--write` puts the figures into docs/results/emulation.json.
"""

import argparse
import json
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skimage import data

from polarnet.events.stream import Events
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.runtime.machine import tune
from polarnet.simulation.camera import Camera
from polarnet.simulation.motion import HARMONICS, Sine, Trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.scene import PolarizationScene, scene_from_rgb
from polarnet.storage.events import EventStore
from studies.simulated_rig import Drift
from studies.simulation_pictures import QUIET
from studies.study import arguments_of, command_line, in_own_process, machine_record, run_stage, write_section

HEIGHT, WIDTH, DURATION_US, SPEED_PX_S = 120, 180, 1_000_000, 110.0
DEFAULT = replace(SENSORS["default"], model="v2e")  # v2e's command-line defaults
MODELS = ("v2e", "exact", "esim", "dvs_voltmeter")
THREADS = (1, 2)
ROUNDS, REPEATS = 3, 9  # processes of each model and number of threads, runs of each process
TIMED_MODELS, REFERENCE_HZ, TIMED_HZ = ("v2e", "exact"), 4800.0, 300.0
PAPER_SEQUENCES, PAPER_SEQUENCES_A_PICTURE, PAPER_WORKERS = 1000, 5, 2


def clip() -> tuple[PolarizationScene, Trajectory]:
    """The coffee photograph, 400 x 600, and the motion over it."""
    scene = scene_from_rgb(torch.from_numpy(data.coffee()).permute(2, 0, 1).float() / 255)
    x, y, still = (scene.width - 1) / 2, (scene.height - 1) / 2, Sine(0.0, 0.0, 0.0)
    return scene, Drift(x, y, (still,) * HARMONICS, (still,) * HARMONICS, still, still, SPEED_PX_S)


def measure_one(model: str, threads: int) -> dict[str, Any]:
    """Seconds of each run, events and peak memory of one model in this process, which is set up as stages are."""
    torch.set_num_threads(threads)
    tune()
    scene, path = clip()
    config, seconds = replace(DEFAULT, model=model), []
    for _ in range(REPEATS + 1):  # the first compiles
        start = time.perf_counter()
        events = emulate_motion(Camera(config, key=1), scene, path, DURATION_US, (HEIGHT, WIDTH), threads)
        seconds.append(time.perf_counter() - start)
    peak_mib = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return {"seconds": seconds[1:], "events": sum(map(len, events)), "peak_mib": peak_mib}


def measure_models() -> dict[str, dict[str, Any]]:
    """Seconds on one and two threads, rate of events and peak memory by model."""
    runs: dict[tuple[str, int], list[dict[str, Any]]] = {(model, t): [] for model in MODELS for t in THREADS}
    for _ in range(ROUNDS):
        for model, threads in runs:
            runs[model, threads].append(in_own_process("studies.speed_of_simulation", "--one", model, threads))
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


def timing_errors_ms() -> dict[str, float]:
    """Mean absolute error of time stamps at `TIMED_HZ`, by model."""
    scene, path = clip()

    def events_of(model: str, rate_hz: float) -> list[Events]:
        config = replace(QUIET, model=model, render_rate_hz=rate_hz)
        return list(emulate_motion(Camera(config, key=1), scene, path, DURATION_US, (HEIGHT, WIDTH)))

    reference = events_of("exact", REFERENCE_HZ)
    return {model: round(timing_error_ms(events_of(model, TIMED_HZ), reference), 3) for model in TIMED_MODELS}


def timing_error_ms(events: list[Events], reference: list[Events]) -> float:
    """Mean absolute difference of stamps in the pixels whose polarities agree."""
    differences = [
        np.abs(t - u)
        for ours, theirs in zip(events, reference, strict=True)
        for (t, p), (u, q) in zip(_by_pixel(ours), _by_pixel(theirs), strict=True)
        if np.array_equal(p, q)
    ]
    return float(np.concatenate(differences).mean()) / 1000


def _by_pixel(events: Events) -> list[tuple[np.ndarray, np.ndarray]]:
    pixel = events.y.numpy().astype(np.int64) * events.width + events.x.numpy()
    order = np.argsort(pixel, kind="stable")
    cuts = np.searchsorted(pixel[order], np.arange(1, events.height * events.width))
    return list(zip(np.split(events.t.numpy()[order], cuts), np.split(events.p.numpy()[order], cuts), strict=True))


def measure_paper_set(sequences: int) -> dict[str, Any]:
    """Minutes of the three stages from RGB to the event store, for about `sequences`, and the store's size."""
    pictures, stage_minutes = max(len(BUILTIN_PHOTOS), sequences // PAPER_SEQUENCES_A_PICTURE), {}
    with tempfile.TemporaryDirectory() as folder:
        for stage in ("ingest", "synthesize", "emulate"):
            start = time.perf_counter()
            run_stage(
                stage, "experiment=paper", "ingest.source=builtin",
                f"ingest.dead_leaves={pictures - len(BUILTIN_PHOTOS)}",
                f"synthesize.sequences_per_picture={PAPER_SEQUENCES_A_PICTURE}",
                f"runtime.workers={PAPER_WORKERS}", f"paths.data={folder}", f"hydra.run.dir={folder}/log",
            )  # fmt: skip
            stage_minutes[stage] = round((time.perf_counter() - start) / 60, 3)
        store = EventStore.open(Path(folder) / "events.zarr")
        size = sum(file.stat().st_size for file in Path(folder, "events.zarr").rglob("*") if file.is_file())
    return {
        "sequences": len(store.sequences),
        "workers": PAPER_WORKERS,
        "minutes": round(sum(stage_minutes.values()), 2),
        "stage_minutes": stage_minutes,
        "event_store_gb": round(size / 1e9, 2),
    }


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/emulation.json")
    parser.add_argument("--paper-set", type=int, default=PAPER_SEQUENCES, metavar="N", help="0: do not make it")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    arguments = arguments_of(parser)
    if arguments.one:
        model, threads = arguments.one
        print(json.dumps(measure_one(model, int(threads))))
        return
    record, models = machine_record(), measure_models()
    for model, error in timing_errors_ms().items():
        models[model]["timing_error_ms"] = error
    print(json.dumps(models, indent=2), flush=True)
    paper_set = measure_paper_set(arguments.paper_set) if arguments.paper_set else None
    print("paper_set", paper_set)
    if arguments.write:
        write_section("emulation", "models", models, record, paper_set and {"paper_set": paper_set})


if __name__ == "__main__":
    main()
