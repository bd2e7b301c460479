"""Time the first picture and the benchmark of own scenes, and check that launchers, clusters and stores change nothing.

python -m studies.speed [demo] [scenes --scenes FOLDER [--methods NAMES] [--overrides KEY=VALUE ...]]
    [launchers] [search] [dask] [s3] [ddp] --data FOLDER [--write]

`demo` and `scenes` go to docs/results/speed.json, the others to docs/results/sweeps.json. `--data` is a folder that the
stages up to `weights` filled with `experiment=smoke`.
"""

import argparse
import csv
import filecmp
import functools
import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fsspec

from polarnet.config.sweep import sweep_points, sweep_rows
from polarnet.config.tree import DOLP_TRAINING
from polarnet.runtime.cluster import pmap
from polarnet.training.engine.history import read_history
from studies.clones import BUCKET, s3_server
from studies.measure import ROOT, arguments_of, command_line, machine_record, write_section

LAUNCHERS = {
    "basic": [],
    "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
    "submitit_local": ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=60"],
}
SHORT = ["network=paper", "train.windows=2", "train.bptt_windows=2", "train.crop=[40,60]", "runtime.threads=1"]
SWEEP = [*SHORT, "loss.mse=1.0,10.0", "loss.ssim=0.0,1.0", "loss.lpips=0.0,1.0"]
SWEEP_ROWS = "benchmark.methods=[zeros,ours]"
KILLED_AFTER = 4
"""Finished points of the sweep that is killed."""
SEARCH = ["loss.mse=1.0:30.0:log", "loss.ssim=0.0,1.0", "train.learning_rate=0.0003:0.01:log"]
TRIALS = 12
DDP = ["train.precision=fp32", "train.epochs=2", "train.batch_size=2"]
SPLITS = ("train", "val")


def polarnet(*words: str | Path, cwd: Path = ROOT, **environment: str) -> float:
    """Run the command `polarnet`; returns its seconds."""
    started = time.monotonic()
    command = [sys.executable, "-m", "polarnet.cli", *map(str, words)]
    subprocess.run(command, cwd=cwd, check=True, env=os.environ | {"PYTHONPATH": str(ROOT)} | environment)
    return round(time.monotonic() - started, 1)


def words_of(name: str, options: argparse.Namespace, *overrides: str | Path) -> list[str]:
    """Command line of a stage at smoke size on the data of the study."""
    words = [sys.executable, "-m", f"stages.{name}", "experiment=smoke", f"paths.data={options.data}", *overrides]
    return list(map(str, words))


def stage(name: str, options: argparse.Namespace, *overrides: str | Path) -> None:
    """Run a stage; nothing is printed."""
    subprocess.run(words_of(name, options, *overrides), cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def demo(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Seconds of `polarnet demo` outside a clone, with its compilation (first) and without (second)."""
    cache = {"NUMBA_CACHE_DIR": str(folder / "numba")}
    first, second = (polarnet("demo", cwd=folder, **cache) for _ in range(2))
    return {"demo_seconds": first, "demo_again_seconds": second}


def scenes(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Minutes of `polarnet benchmark --scenes` with all cores, the number of scenes, and the rows of its table."""
    methods = ["--methods", options.methods] if options.methods else []
    out = folder / "scenes"
    seconds = polarnet("benchmark", "--scenes", options.scenes, "--out", out, *methods, *options.overrides)
    with (out / "frames.csv").open(newline="") as file:
        frames = list(csv.DictReader(file))
    count = len({frame["scene"] for frame in frames})
    rows = list(dict.fromkeys(frame["method"] for frame in frames))
    return {f"benchmark_{count}_scenes_minutes": round(seconds / 60, 2), "rows": rows}


def launchers(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Whether all launchers give the same scores, and how many finished points a continued sweep runs again.

    The sweep of the basic launcher is killed half-way and continued. Dask runs each point as a task of its own.
    """

    def sweep(name: str) -> int:
        lost = _killed_half_way(options, folder / name) if name == "basic" else lambda: 0
        if name == "dask":
            _dask_points(options, folder / name)
        else:
            stage("trial", options, *LAUNCHERS[name], *SWEEP, SWEEP_ROWS, *_folders(folder / name), "--multirun")
        return lost()

    names = [*LAUNCHERS, "dask"]
    with ThreadPoolExecutor(2) as pool:  # two sweeps at a time
        lost = sum(pool.map(sweep, names))
    scores = {name: _points(folder / name) for name in names}
    return {
        "launchers_equal": all(one == scores["basic"] for one in scores.values()),
        "resumed_trials_lost": lost,
        "killed_after": KILLED_AFTER,
        "points": len(scores["basic"]),
        "launchers": names,
    }


def _folders(sweep: Path) -> list[str]:
    return [f"hydra.sweep.dir={sweep}", f"paths.resume={sweep / 'resume'}"]


def _killed_half_way(options: argparse.Namespace, sweep: Path) -> Callable[[], int]:
    """Kill a sweep once `KILLED_AFTER` points have finished; returns how many of them have been run again by then."""
    words = words_of("trial", options, *SWEEP, SWEEP_ROWS, *_folders(sweep), "--multirun")
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL, start_new_session=True) as process:
        while len(jobs := sorted(sweep.glob("*/finished.json"))) < KILLED_AFTER:
            if process.poll() is not None:
                raise RuntimeError(f"the sweep ended with {len(jobs)} finished points, before it could be killed")
            time.sleep(0.1)
        os.killpg(process.pid, signal.SIGKILL)
    written = {job: job.stat().st_mtime_ns for job in jobs}
    return lambda: sum(job.stat().st_mtime_ns != before for job, before in written.items())


def _dask_points(options: argparse.Namespace, sweep: Path) -> None:
    """Run the sweep's points as tasks of two Dask workers on loopback."""
    from distributed import LocalCluster

    swept = SWEEP[len(SHORT) :]
    values = [[f"{key}={value}" for value in given.split(",")] for key, given in (one.split("=") for one in swept)]
    points = [
        words_of("trial", options, *SHORT, *point, SWEEP_ROWS, f"hydra.run.dir={sweep / str(k)}", _folders(sweep)[1])
        for k, point in enumerate(itertools.product(*values))
    ]
    run = functools.partial(subprocess.run, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        pmap(run, points, workers=1, label="points", address=cluster.scheduler_address)


def _points(sweep: Path) -> list[Any]:
    return [(point["validation"], point["test"]) for point in sweep_points(sweep)]


def search(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Trials of an Optuna search, how many were stopped, how many a second start runs, and the best point."""
    words = [*SHORT, "train.epochs=2", SWEEP_ROWS, *SEARCH, f"paths.resume={folder / 'resume'}"]
    asked = ["--trials", str(TRIALS), "--jobs", "2", "--out", str(folder / "search")]
    started = time.monotonic()
    stage("search", options, *words, *asked)
    minutes = round((time.monotonic() - started) / 60, 2)
    again = subprocess.run(
        words_of("search", options, *words, *asked), cwd=ROOT, check=True, capture_output=True, text=True
    )
    rows = sweep_rows(sweep_points(folder / "search"))
    stopped = [path for path in (folder / "search").glob("*/failure.txt") if path.read_text().startswith("stopped")]
    own = [one for one in rows[0]["overrides"] if one.partition("=")[0] in {word.partition("=")[0] for word in SEARCH}]
    return {
        "trials": len(rows),
        "stopped": len(stopped),
        "finished": sum(not row["failed_seeds"] for row in rows),
        "ran_again": int(again.stdout.split(" trials ran now")[0].split()[-1]),
        "minutes": minutes,
        "best": {"overrides": own, "validation_mse": rows[0]["validation"]["mse"]["mean"]},
    }


def dask(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Deaths of a Dask worker and of the scheduler on loopback: whether the rerun gives the bytes of one process.

    Counts the parts of the events that were finished before the rerun, and how many of them it computed again.
    """
    scenes = [f"paths.{name}={folder / name}.zarr" for name in ("scenes", "frames")]
    stage("synthesize", options, "storage.sequences_per_part=1", *scenes)
    stage("emulate", options, scenes[0], f"paths.events={folder / 'alone.zarr'}")
    alone, events, unfinished = (folder / name for name in ("alone.zarr", "dask.zarr", "dask.zarr.tmp"))
    overrides = [scenes[0], f"paths.events={events}"]
    with dask_on_loopback() as (address, scheduler, workers):
        words = words_of("emulate", options, *overrides, f"cluster.address={address}")
        with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
            for victim in (workers[0], scheduler):
                count = len(identities(unfinished))
                while len(identities(unfinished)) <= count:
                    if process.poll() is not None:
                        raise RuntimeError("the stage ended before the worker and the scheduler were killed")
                    time.sleep(0.001)
                victim.kill()
            assert process.stderr is not None
            message = process.stderr.read().strip().splitlines()[-1]
    before = identities(unfinished)
    with dask_on_loopback() as (address, _, _):
        stage("emulate", options, *overrides, f"cluster.address={address}")
    names = sorted(path.name for path in alone.iterdir())
    _, different, missing = filecmp.cmpfiles(alone, events, names, shallow=False)
    after = identities(events)
    return {
        "bytes_equal": not different and not missing,
        "files": len(names),
        "workers": len(workers),
        "message": message,
        "finished_before_rerun": len(before),
        "computed_twice": sum(after[part] != identity for part, identity in before.items()),
    }


def identities(store: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of every finished part of a store: others if it is written again, even with equal bytes."""
    status = {path.name: path.stat() for path in store.glob("part-?????.zip")}
    return {name: (one.st_ino, one.st_mtime_ns) for name, one in status.items()}


@contextmanager
def dask_on_loopback() -> Iterator[tuple[str, subprocess.Popen[bytes], list[subprocess.Popen[bytes]]]]:
    """Address of a new Dask scheduler, its process, and those of two workers of one thread."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        host, port = free.getsockname()
    address = f"tcp://{host}:{port}"

    def start(kind: str, *words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--no-dashboard", *words]
        return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)

    scheduler = start("scheduler", "--host", host, "--port", str(port))
    workers = [start("worker", address, "--nthreads", "1", "--no-nanny") for _ in range(2)]
    try:
        yield address, scheduler, workers
    finally:
        for process in (scheduler, *workers):
            process.kill()
            process.wait()


def s3(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Whether stages that write and read an S3-compatible server on loopback give the bytes of local stores.

    Training compares its loss in every epoch.
    """
    with s3_server() as address:
        os.environ["AWS_ENDPOINT_URL"] = address
        bucket, remote = fsspec.filesystem("s3"), f"s3://{BUCKET}"
        for place in (folder, remote):
            stores = [f"paths.{name}={place}/{name}.zarr" for name in ("scenes", "frames", "events")]
            stage("synthesize", options, *stores)
            stage("emulate", options, *stores)
            trained = folder / ("here" if place == folder else "there")
            stage("train", options, *stores, f"paths.train={trained}", f"paths.resume={folder / 'resume'}")
        files = list(folder.glob("*.zarr/*"))
        equal = [path.read_bytes() == bucket.cat(f"{BUCKET}/{path.relative_to(folder)}") for path in files]
    here, there = (read_history(folder / name / DOLP_TRAINING) for name in ("here", "there"))
    return {"bytes_equal": all(equal), "files": len(files), "losses_equal": here == there}


def ddp(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Largest difference between the losses of a training by two processes (torchrun, gloo) and by one, in float32."""
    histories = []
    for processes in (1, 2):
        words = [f"runtime.devices={processes}", "runtime.device=cpu", "runtime.threads=1", *DDP]
        stage("train", options, *words, *(f"paths.{name}={folder / str(processes)}" for name in ("train", "resume")))
        histories.append(read_history(folder / str(processes) / DOLP_TRAINING))
    rows = list(zip(*histories, strict=True))
    pairs = [(one[split]["total"], two[split]["total"]) for split in SPLITS for one, two in rows]
    return {
        "ddp_loss_difference": max(abs(one - two) for one, two in pairs),
        "losses": {"one_process": [one for one, _ in pairs], "two_processes": [two for _, two in pairs]},
        "overrides": DDP,
    }


STUDIES: dict[str, tuple[str, Callable[[argparse.Namespace, Path], dict[str, Any]]]] = {
    "demo": ("speed", demo),
    "scenes": ("speed", scenes),
    "launchers": ("sweeps", launchers),
    "search": ("sweeps", search),
    "dask": ("sweeps", dask),
    "s3": ("sweeps", s3),
    "ddp": ("sweeps", ddp),
}
ON_DATA = ("launchers", "search", "dask", "s3", "ddp")
HEADLINES = (
    "demo_seconds", "benchmark_43_scenes_minutes", "launchers_equal", "resumed_trials_lost", "ddp_loss_difference",
)  # fmt: skip


def main() -> None:
    """Run the studies, print and perhaps write."""
    parser = command_line(__doc__, "docs/results/speed.json and sweeps.json")
    parser.add_argument("studies", nargs="+", choices=tuple(STUDIES))
    parser.add_argument("--scenes", type=Path, help="folder of photographs")
    parser.add_argument("--methods", help="rows for scenes, separated by commas; default: those of params.yaml")
    parser.add_argument("--overrides", nargs="*", default=[], help="for scenes: methods.firenet_published.weights=FILE")
    parser.add_argument("--data", type=Path, help="folder of the stages' data at smoke size")
    options = arguments_of(parser)
    if "scenes" in options.studies and not options.scenes:
        parser.error("scenes: give --scenes FOLDER")
    if set(ON_DATA).intersection(options.studies) and not options.data:
        parser.error(f"{', '.join(ON_DATA)}: give --data FOLDER")
    options.data = options.data and options.data.resolve()
    options.scenes = options.scenes and options.scenes.resolve()
    for name in options.studies:
        file, study = STUDIES[name]
        record, folder = machine_record(ROOT), Path(tempfile.mkdtemp())
        try:
            figures = study(options, folder)
        finally:
            shutil.rmtree(folder)
        print(json.dumps({name: figures}, indent=2))
        if options.write:
            above = {key: figures[key] for key in HEADLINES if key in figures}
            print(f"wrote {write_section(ROOT, file, name, figures, record, above)}")


if __name__ == "__main__":
    main()
