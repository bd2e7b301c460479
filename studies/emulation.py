"""Speed and accuracy of the emulator: python -m studies.emulation [--write] [--before COMMIT] [--paper-set N]

The clip is that of the shared reference figures: scikit-image's coffee photograph mapped to polarization, a sensor of
120 x 180 pixels that drifts over it at 110 px/s, 300 steps a second, four channels, one second. Times run from
rendering to columns in memory and are medians of wall-clock time with compiled kernels. Every model and number of
threads runs in its own process, and the processes take turns over several rounds, so that other load on the machine
affects all of them alike. Each process also reports its peak memory. `--before COMMIT` times an earlier commit in the
same rounds, in a git worktree of its own. Its figures, and its seconds over today's, are entered under `before`.

Timing errors are those of noiseless pixels with equal thresholds, relative to `exact` at 4800 steps a second. They
cover the pixels whose polarities agree from the first event to the last. `exact` places its steps where pixels meet;
its figure for regular frames is printed too.

The paper's set is made with `python -m stages.ingest`, `stages.synthesize` and `stages.emulate`, with experiment=paper
on two workers, from the built-in photographs and dead leaves. Minutes are wall-clock time. Peak memory is the largest
sum over a stage's processes, sampled twice a second; shared pages count once (Linux: proportional set size).
The files of the scene, frame and event stores are counted. `--paper-set N` makes about N sequences instead of 1000, and
minutes are never scaled. `--paper-set 0` skips the set, `--only-paper-set` skips everything else.

The passed cases of tests/golden are counted. `--write` merges the figures into docs/results/emulation.json.
"""

import argparse
import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import psutil
import torch
from skimage import data

from polarnet.events.stream import Events
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.runtime.machine import tune
from polarnet.simulation.camera import Camera
from polarnet.simulation.motion import HARMONICS, Pose, Sine, Trajectory
from polarnet.simulation.moving_sensor import emulate_motion, emulate_motion_steps
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.scene import PolarizationScene, scene_from_rgb
from polarnet.storage.events import EventStore
from studies.measure import arguments_of, command_line, machine_record

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results" / "emulation.json"
HEIGHT, WIDTH, DURATION_US, SPEED_PX_S = 120, 180, 1_000_000, 110.0
STILL = Sine(0.0, 0.0, 0.0)
DEFAULT = replace(SENSORS["default"], model="v2e")  # v2e's command-line defaults
NOISELESS = replace(
    DEFAULT,
    contrast_threshold_sigma_on=0.0,
    contrast_threshold_sigma_off=0.0,
    cutoff_hz=0.0,
    leak_rate_hz=0.0,
    shot_noise_rate_hz=0.0,
    refractory_period_us=0.0,
)
MODELS = {
    "v2e_default": DEFAULT,
    "exact": replace(DEFAULT, model="exact"),
    "esim": replace(DEFAULT, model="esim"),
    "dvs_voltmeter": replace(DEFAULT, model="dvs_voltmeter"),
}
PAPER_SEQUENCES, PAPER_SEQUENCES_A_PICTURE, PAPER_WORKERS = 1000, 5, 2
STORES = ("scenes.zarr", "frames.zarr", "events.zarr")  # whose files are counted
MEMORY_SAMPLES_A_SECOND = 2
THREADS = (1, 2)


class Drift(Trajectory):
    """A window that starts in the middle of a scene and moves right at constant speed."""

    def pose(self, t_s: np.ndarray) -> Pose:
        """The window at times in seconds."""
        still = np.zeros_like(t_s)
        return Pose(self.x + self.speed_px_s * t_s, self.y + still, still, still + 1)


def benchmark_scene() -> tuple[PolarizationScene, Drift]:
    """The coffee photograph, 400 x 600, and the motion over it."""
    scene = scene_from_rgb(torch.from_numpy(data.coffee()).permute(2, 0, 1).float() / 255)
    x, y = (scene.width - 1) / 2, (scene.height - 1) / 2
    return scene, Drift(x, y, (STILL,) * HARMONICS, (STILL,) * HARMONICS, STILL, STILL, SPEED_PX_S)


def measure_one(name: str, threads: int, repeats: int) -> dict[str, Any]:
    """Seconds of each run, events and peak memory of one model in this process, which is set up as stages are."""
    torch.set_num_threads(threads)
    tune()
    scene, path = benchmark_scene()
    seconds = []
    for _ in range(repeats + 1):  # the first compiles
        start = time.perf_counter()
        events = emulate_motion(Camera(MODELS[name], key=1), scene, path, DURATION_US, (HEIGHT, WIDTH), threads)
        seconds.append(time.perf_counter() - start)
    return {
        "seconds": seconds[1:],
        "events": sum(map(len, events)),
        "peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def in_own_process(name: str, threads: int, repeats: int, tree: Path) -> dict[str, Any]:
    """`measure_one` in a new process of this script, as it stands in the working tree `tree`."""
    command = [
        sys.executable,
        "-m",
        "studies.emulation",
        "--one",
        name,
        "--threads",
        str(threads),
        "--repeats",
        str(repeats),
    ]
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "PYTHONPATH": str(tree)}
    done = subprocess.run(command, cwd=tree, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


def figures_of(name: str, processes: dict[int, list[dict[str, Any]]]) -> dict[str, Any]:
    """Figures of one model, from its processes by their number of threads."""
    medians = {t: float(np.median(np.concatenate([one["seconds"] for one in ones]))) for t, ones in processes.items()}
    one, steps = processes[1][0], DURATION_US * 1e-6 * float(MODELS[name].render_rate_hz or 0)
    return {
        "seconds_1_thread": round(medians[1], 4),
        "seconds_2_threads": round(medians[2], 4),
        "mpixel_updates_per_s": round(4 * HEIGHT * WIDTH * steps / medians[1] * 1e-6, 1),
        "mevents_per_s": round(one["events"] / medians[1] * 1e-6, 2),
        "events": one["events"],
        "peak_mib": one["peak_mib"],
    }


def timing_error_ms(events: list[Events], reference: list[Events]) -> tuple[float, float]:
    """Mean absolute difference of stamps where a pixel's polarities agree, and the share of events in such pixels."""
    total_us, compared = 0, 0
    for ours, theirs in zip(events, reference, strict=True):
        pairs = zip(_by_pixel(ours), _by_pixel(theirs), strict=True)
        for (t, p), (u, q) in pairs:
            if np.array_equal(p, q):
                total_us += int(abs(t - u).sum())
                compared += len(t)
    return total_us / compared / 1000, compared / sum(map(len, reference))


def _by_pixel(events: Events) -> list[tuple[np.ndarray, np.ndarray]]:
    pixel = events.y.numpy().astype(np.int64) * events.width + events.x.numpy()
    order = np.argsort(pixel, kind="stable")
    cuts = np.searchsorted(pixel[order], np.arange(1, events.height * events.width))
    return list(zip(np.split(events.t.numpy()[order], cuts), np.split(events.p.numpy()[order], cuts), strict=True))


def measure_timing() -> dict[str, dict[str, float]]:
    """Timing errors of `exact` and, for comparison, `v2e`."""
    scene, path = benchmark_scene()

    def at(model: str, rate: float) -> list[Events]:
        config = replace(NOISELESS, model=model, render_rate_hz=rate)
        return emulate_motion(Camera(config, key=1), scene, path, DURATION_US, (HEIGHT, WIDTH))

    def at_regular_frames(rate: float) -> list[Events]:
        t_us = np.rint(np.arange(int(rate) + 1) * 1e6 / rate).astype(np.int64)
        config = replace(NOISELESS, model="exact")
        return emulate_motion_steps(Camera(config, key=1), scene, path, t_us, (HEIGHT, WIDTH))[0]

    reference = at("exact", 4800.0)
    figures: dict[str, dict[str, float]] = {"exact": {}, "v2e_default": {}}
    for rate in (300, 120):
        for name, events, suffix in (
            ("exact", at("exact", rate), ""),
            ("exact", at_regular_frames(rate), "_regular_frames"),
            ("v2e_default", at("v2e", rate), ""),
        ):
            error, share = timing_error_ms(events, reference)
            figures[name][f"timing_error_ms_{rate}fps{suffix}"] = round(error, 3)
            figures[name][f"agreeing_share_{rate}fps{suffix}"] = round(share, 3)
    return figures


def golden_cases_passed() -> int:
    """Number of reference cases met, out of 15 of v2e and 8 of ESIM."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "golden.xml"
        tests = ROOT / "tests" / "reference" / "test_golden.py"
        command = [sys.executable, "-m", "pytest", "-q", "-k", "case", f"--junitxml={report}", str(tests)]
        subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL, check=False)  # failures are what is counted
        cases = ElementTree.parse(report).iter("testcase")
        return sum("_case[" in case.attrib["name"] and len(case) == 0 for case in cases)  # no failure or skip inside


def measure_paper_set(sequences: int) -> dict[str, Any]:
    """Minutes, core minutes and memory of the three stages from RGB to the event store, for about `sequences`."""
    pictures = max(len(BUILTIN_PHOTOS), sequences // PAPER_SEQUENCES_A_PICTURE)
    stage_minutes, core_minutes, peak_mib = {}, {}, 0.0
    with tempfile.TemporaryDirectory() as folder:
        overrides = [
            "experiment=paper",
            "ingest.source=builtin",
            f"ingest.dead_leaves={pictures - len(BUILTIN_PHOTOS)}",
            f"synthesize.sequences_per_picture={PAPER_SEQUENCES_A_PICTURE}",
            f"runtime.workers={PAPER_WORKERS}",
            f"paths.data={folder}",
            f"hydra.run.dir={folder}/log",
        ]
        for stage in ("ingest", "synthesize", "emulate"):
            command = [sys.executable, "-m", f"stages.{stage}", *overrides]
            minutes, core_minutes[stage], mib = _watched(command)
            stage_minutes[stage], peak_mib = round(minutes, 3), max(peak_mib, mib)
            print(f"{stage}: {minutes:.2f} min, {core_minutes[stage]:.2f} core minutes, {mib:.0f} MiB")
        store = EventStore.open(Path(folder) / "events.zarr")
        events = sum(sum(store.count(sequence)) for sequence in store.sequences)
        stored_mib = sum(file.stat().st_size for file in Path(store.path).rglob("*") if file.is_file()) / 2**20
        files = sum(file.is_file() for kind in STORES for file in Path(folder, kind).rglob("*"))
    return {
        "sequences": len(store.sequences),
        "sequences_per_picture": PAPER_SEQUENCES_A_PICTURE,
        "workers": PAPER_WORKERS,
        "minutes": round(sum(stage_minutes.values()), 2),
        "stage_minutes": stage_minutes,
        "stage_core_minutes": {stage: round(minutes, 3) for stage, minutes in core_minutes.items()},
        "peak_mib": round(peak_mib),
        "events": events,
        "event_store_mib": round(stored_mib),
        "files": files,
        "load": round(os.getloadavg()[0], 2),
    }


def _watched(command: list[str]) -> tuple[float, float, float]:
    """Run a command: its minutes, the minutes of all cores, and its peak memory in MiB with all its children."""
    before, start, peak = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter(), 0
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            peak = max(peak, _held_bytes(process.pid))
            time.sleep(1 / MEMORY_SAMPLES_A_SECOND)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cores_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return (time.perf_counter() - start) / 60, cores_s / 60, peak / 2**20


def _held_bytes(pid: int) -> int:
    total = 0
    try:
        for process in (parent := psutil.Process(pid), *parent.children(recursive=True)):
            total += process.memory_full_info().pss
    except psutil.NoSuchProcess:  # it ended just now; the next look counts the rest
        pass
    return total


def full_name(commit: str) -> str:
    """The hash of a commit that is named in any way git understands."""
    command = ["git", "rev-parse", "--verify", f"{commit}^{{commit}}"]
    return subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


@contextlib.contextmanager
def worktree_of(commit: str) -> Iterator[Path]:
    """A working tree of `commit`, deleted at the end."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "before"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(tree), commit], cwd=ROOT, check=True)
        try:
            yield tree
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT, check=True)


def measure_trees(trees: list[Path], rounds: int, repeats: int) -> list[dict[str, Any]]:
    """Figures of the models in each working tree; the trees take turns as well."""
    processes: list[dict[str, dict[int, list[dict[str, Any]]]]] = [
        {name: {t: [] for t in THREADS} for name in MODELS} for _ in trees
    ]
    for _ in range(rounds):
        for threads in THREADS:
            for name in MODELS:
                for tree, results in zip(trees, processes, strict=True):
                    one = in_own_process(name, threads, repeats, tree)
                    results[name][threads].append(one)
                    print(f"{tree.name} {name:14s} {threads} thread(s): {np.median(one['seconds']):.4f} s", flush=True)
    return [{name: figures_of(name, results[name]) for name in MODELS} for results in processes]


def measure(rounds: int, repeats: int, before: str | None) -> dict[str, Any]:
    """All figures of the models, printed as they come; `before` names a commit to time beside them."""
    figures: dict[str, Any]
    if before is None:
        (figures,) = measure_trees([ROOT], rounds, repeats)
    else:
        with worktree_of(before) as tree:
            figures, earlier = measure_trees([ROOT, tree], rounds, repeats)
        for name, of_model in earlier.items():
            for seconds in (key for key in tuple(of_model) if key.startswith("seconds")):
                of_model[f"{seconds}_over_present"] = round(of_model[seconds] / figures[name][seconds], 3)
            print("before", name, of_model)
        figures["before"] = {"commit": full_name(before), **earlier}
    for name in MODELS:
        print(name, figures[name])
    for name, errors in measure_timing().items():
        figures[name] |= errors
        print(name, errors)
    figures["golden_cases_passed"] = golden_cases_passed()
    print(f"golden cases passed: {figures['golden_cases_passed']} of 23")
    return figures


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/emulation.json")
    parser.add_argument("--rounds", type=int, default=3, help="processes of each model and number of threads")
    parser.add_argument("--repeats", type=int, default=9, help="runs of each process; the median of all counts")
    parser.add_argument(
        "--paper-set", type=int, default=PAPER_SEQUENCES, metavar="N", help="sequences of the paper's set to make"
    )
    parser.add_argument("--only-paper-set", action="store_true", help="measure nothing else")
    parser.add_argument("--before", metavar="COMMIT", help="earlier commit to time in the same rounds")
    parser.add_argument("--one", choices=list(MODELS), help=argparse.SUPPRESS)
    parser.add_argument("--threads", type=int, default=1, help=argparse.SUPPRESS)
    arguments = arguments_of(parser)
    if arguments.one:
        print(json.dumps(measure_one(arguments.one, arguments.threads, arguments.repeats)))
        return
    figures: dict[str, Any] = machine_record(ROOT)
    print(f"{figures['machine']}, {figures['cores']} cores, load {figures['load']}")
    if not arguments.only_paper_set:
        figures |= measure(arguments.rounds, arguments.repeats, arguments.before)
    if arguments.paper_set:
        figures["paper_set"] = measure_paper_set(arguments.paper_set)
        print("paper_set", figures["paper_set"])
    if arguments.write:
        known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        RESULTS.parent.mkdir(parents=True, exist_ok=True)
        RESULTS.write_text(json.dumps(known | figures, indent=2) + "\n")
        print(f"written to {RESULTS.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
