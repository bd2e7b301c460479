"""Time the first picture and the benchmark of own scenes, and check that launchers, clusters and stores change nothing.

python -m studies.speed [demo] [scenes --scenes FOLDER] [launchers] [search] [dask] [s3] --data FOLDER [--write]

`demo` and `scenes` go to docs/results/speed.json, the others to docs/results/sweeps.json. `--data` is a folder that the
stages up to `weights` filled with `experiment=smoke`.
"""

import argparse
import filecmp
import functools
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from polarnet.config.sweep import write_comparison
from polarnet.runtime.cluster import pmap
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
    """Minutes of `polarnet benchmark --scenes` with all cores, and the number of scenes."""
    seconds = polarnet("benchmark", "--scenes", options.scenes, "--out", folder / "scenes")
    lines = (folder / "scenes" / "frames.csv").read_text().splitlines()[1:]
    count = len({line.split(",")[1] for line in lines})
    return {f"benchmark_{count}_scenes_minutes": round(seconds / 60, 2)}


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
    """Run the sweep's points as tasks of two Dask workers on loopback, and write its table."""
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
    write_comparison(sweep)


def _points(sweep: Path) -> list[Any]:
    content = json.loads((sweep / "comparison.json").read_text())
    return [(point["validation"], point["test"]) for point in content["points"]]


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
    rows = json.loads((folder / "search" / "comparison.json").read_text())["rows"]
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
    """Whether the events of two Dask workers on loopback are those of one process, byte for byte."""
    from distributed import LocalCluster

    stage("emulate", options, f"paths.events={folder / 'alone.zarr'}")
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        stage(
            "emulate", options, f"paths.events={folder / 'dask.zarr'}", f"cluster.address={cluster.scheduler_address}"
        )
    names = sorted(path.name for path in (folder / "alone.zarr").iterdir())
    _, different, missing = filecmp.cmpfiles(folder / "alone.zarr", folder / "dask.zarr", names, shallow=False)
    return {"bytes_equal": not different and not missing, "files": len(names), "workers": 2}


def s3(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Whether events read from an S3-compatible server on loopback are those of the local store."""
    import s3fs
    import torch
    from moto.server import ThreadedMotoServer

    from polarnet.storage.events import EventStore

    server = ThreadedMotoServer(port=0)
    server.start()
    try:
        host, port = server.get_host_and_port()
        os.environ |= {"AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_DEFAULT_REGION": "us-east-1"}
        os.environ |= {"AWS_ACCESS_KEY_ID": "loopback", "AWS_SECRET_ACCESS_KEY": "loopback"}
        remote = s3fs.S3FileSystem()
        remote.mkdir("polarnet")
        remote.put(str(options.data / "events.zarr"), "polarnet/events.zarr", recursive=True)
        here, there = EventStore.open(options.data / "events.zarr"), EventStore.open("s3://polarnet/events.zarr")
        equal = here.sequences == there.sequences and all(
            torch.equal(a, b)
            for name in here.sequences
            for one, other in zip(here.read(name), there.read(name), strict=True)
            for a, b in zip((one.t, one.x, one.y, one.p), (other.t, other.x, other.y, other.p), strict=True)
        )
    finally:
        server.stop()
    return {"bytes_equal": equal, "sequences": len(here.sequences)}


STUDIES: dict[str, tuple[str, Callable[[argparse.Namespace, Path], dict[str, Any]]]] = {
    "demo": ("speed", demo),
    "scenes": ("speed", scenes),
    "launchers": ("sweeps", launchers),
    "search": ("sweeps", search),
    "dask": ("sweeps", dask),
    "s3": ("sweeps", s3),
}
HEADLINES = ("demo_seconds", "benchmark_43_scenes_minutes", "launchers_equal", "resumed_trials_lost")


def main() -> None:
    """Run the studies, print and perhaps write."""
    parser = command_line(__doc__, "docs/results/speed.json and sweeps.json")
    parser.add_argument("studies", nargs="+", choices=tuple(STUDIES))
    parser.add_argument("--scenes", type=Path, help="folder of photographs")
    parser.add_argument("--data", type=Path, help="folder of the stages' data at smoke size")
    options = arguments_of(parser)
    if "scenes" in options.studies and not options.scenes:
        parser.error("scenes: give --scenes FOLDER")
    if {"launchers", "search", "dask", "s3"}.intersection(options.studies) and not options.data:
        parser.error("launchers, search, dask, s3: give --data FOLDER")
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
