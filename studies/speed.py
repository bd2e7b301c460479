"""Time the first picture and the benchmark of own scenes, and check that launchers, clusters and stores change nothing.

python -m studies.speed [demo] [scenes --scenes FOLDER] [launchers] [dask] [s3] --data FOLDER [--write]

`demo` and `scenes` go to docs/results/speed.json, the others to docs/results/sweeps.json. `--data` is a folder that the
stages up to `weights` filled with `experiment=smoke`.
"""

import argparse
import filecmp
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from studies.measure import ROOT, arguments_of, command_line, machine_record, write_section

LAUNCHERS = {
    "basic": [],
    "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
    "submitit_local": ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=60"],
}
SWEEP = [
    "network=paper",
    "train.windows=2",
    "train.bptt_windows=2",
    "runtime.threads=1",
    "loss.mse=1.0,10.0",
    "seed=1,2",
]
SWEEP_ROWS = "benchmark.methods=[zeros,ours]"


def polarnet(*words: str | Path, cwd: Path = ROOT, **environment: str) -> float:
    """Run the command `polarnet`; returns its seconds."""
    started = time.monotonic()
    command = [sys.executable, "-m", "polarnet.cli", *map(str, words)]
    subprocess.run(command, cwd=cwd, check=True, env=os.environ | {"PYTHONPATH": str(ROOT)} | environment)
    return round(time.monotonic() - started, 1)


def stage(name: str, options: argparse.Namespace, *overrides: str | Path) -> None:
    """Run a stage at smoke size on the data of the study; nothing is printed."""
    words = [sys.executable, "-m", f"stages.{name}", "experiment=smoke", f"paths.data={options.data}", *overrides]
    subprocess.run(list(map(str, words)), cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


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
    """Whether all launchers give the same scores, and how many finished points a continued sweep runs again."""
    scores = {}
    for name, chosen in LAUNCHERS.items():
        paths = [f"hydra.sweep.dir={folder / name}", f"paths.resume={folder / name / 'resume'}"]
        stage("trial", options, *chosen, *SWEEP, SWEEP_ROWS, *paths, "--multirun")
        scores[name] = _points(folder / name)
    jobs = sorted(path.parent for path in (folder / "basic").glob("*/finished.json"))
    (jobs[-1] / "finished.json").unlink()  # as if the sweep had been killed before its last point ended
    before = {job: (job / "benchmark" / "metrics.json").stat().st_mtime_ns for job in jobs}
    paths = [f"hydra.sweep.dir={folder / 'basic'}", f"paths.resume={folder / 'basic' / 'resume'}"]
    stage("trial", options, *SWEEP, SWEEP_ROWS, *paths, "--multirun")
    again = sum((job / "benchmark" / "metrics.json").stat().st_mtime_ns != before[job] for job in jobs[:-1])
    equal = all(one == scores["basic"] for one in scores.values()) and _points(folder / "basic") == scores["basic"]
    return {"launchers_equal": equal, "resumed_trials_lost": again, "points": len(jobs), "launchers": [*LAUNCHERS]}


def _points(sweep: Path) -> list[Any]:
    content = json.loads((sweep / "comparison.json").read_text())
    return [(point["validation"], point["test"]) for point in content["points"]]


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
    if {"launchers", "dask", "s3"}.intersection(options.studies) and not options.data:
        parser.error("launchers, dask, s3: give --data FOLDER")
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
