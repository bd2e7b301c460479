"""Check DVC's remotes and its queue in fresh clones of the committed project, at smoke size.

python -m studies.clones [push] [queue] [--target STAGE] [--write]

`push` sends the artefacts to a folder and to an S3-compatible server on loopback, and pulls them into another clone.
It needs the extra `remote` and `pip install 'moto[server]'`. `queue` runs two experiments with two workers. Both
write to docs/results/sweeps.json. `--target` limits the pipeline to a stage and those before it.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from studies.measure import ROOT, STAGE_STARTS, arguments_of, command_line, machine_record, write_section

QUEUED = ("synthesize.speed_max_px_s=120.0", "synthesize.speed_max_px_s=140.0")
POLL_S = 5
BUCKET = "artefacts"


def run(clone: Path, *words: str | Path) -> str:
    """Output of a command in a clone, whose own code it runs; Python modules are given as `-m NAME`."""
    program = [sys.executable, *map(str, words)] if words[0] == "-m" else [*map(str, words)]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {"PATH": path}
    done = subprocess.run(
        program, cwd=clone, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(program)} failed:\n{done.stdout[-3000:]}")
    return done.stdout


def dvc(clone: Path, *words: str | Path) -> str:
    """Output of `dvc WORDS` in a clone."""
    return run(clone, "-m", "dvc", *words)


def executed(output: str) -> list[str]:
    """Stages that `dvc repro` says it ran."""
    return list(dict.fromkeys(STAGE_STARTS.findall(output)))


def reproduced(folder: Path, target: list[str]) -> Path:
    """A clone whose pipeline ran at smoke size, up to `target` if any, and whose lock is committed."""
    clone = folder / "first"
    run(folder, "git", "clone", "--quiet", ROOT, clone)
    run(clone, "-m", "polarnet.cli", "preset", "smoke")
    dvc(clone, "repro", *target)
    commit(clone, "smoke size")
    return clone


def commit(clone: Path, message: str) -> None:
    """Commit all changes of a clone, new files included."""
    run(clone, "git", "add", "--all")
    run(clone, "git", "-c", "user.name=study", "-c", "user.email=study@localhost", "commit", "-qm", message)


def push(clone: Path, target: list[str]) -> dict[str, Any]:
    """Files and bytes of each remote, and the number of stages that another clone executes after `dvc pull`."""
    remotes = {"folder": clone.parent / "remote"}
    with s3_server() as url:
        figures = {
            "folder": _through(clone, target, "folder", remotes["folder"]),
            "s3": _through(clone, target, "s3", f"s3://{BUCKET}", url),
        }
    files = [path for path in remotes["folder"].rglob("*") if path.is_file()]
    return {
        "files": len(files),
        "bytes": sum(path.stat().st_size for path in files),
        "repro_executes": sum(len(one.pop("executed")) for one in figures.values()),
        "bytes_equal": len({one.pop("sha256") for one in figures.values()} | {_digest(clone)}) == 1,
        "remotes": figures,
    }


def _through(clone: Path, target: list[str], name: str, url: str | Path, endpoint: str | None = None) -> dict[str, Any]:
    """Push from `clone` to a new remote and pull into a new clone; seconds, executed stages, and digest of its data."""
    other = clone.parent / f"from_{name}"
    run(clone.parent, "git", "clone", "--quiet", clone, other)
    for one in (clone, other):
        dvc(one, "remote", "add", "--local", "--default", "--force", name, url)
        if endpoint:
            dvc(one, "remote", "modify", "--local", name, "endpointurl", endpoint)
    started = time.monotonic()
    dvc(clone, "push", "--with-deps", *target)
    pushed = time.monotonic()
    dvc(other, "pull", "--with-deps", *target)
    seconds = {"push_seconds": round(pushed - started, 1), "pull_seconds": round(time.monotonic() - pushed, 1)}
    return {**seconds, "executed": executed(dvc(other, "repro", *target)), "sha256": _digest(other)}


def _digest(clone: Path) -> str:
    """One hash of the names and bytes of all files below data/."""
    digest = hashlib.sha256()
    for path in sorted(path for path in (clone / "data").rglob("*") if path.is_file()):
        digest.update(str(path.relative_to(clone)).encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


@contextmanager
def s3_server() -> Iterator[str]:
    """Address of an S3-compatible server on loopback with one empty bucket; its keys are in the environment."""
    import s3fs
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", port=0)
    server.start()
    try:
        host, port = server.get_host_and_port()
        address = f"http://{host}:{port}"
        os.environ |= {"AWS_ACCESS_KEY_ID": "loopback", "AWS_SECRET_ACCESS_KEY": "loopback"}
        os.environ |= {"AWS_DEFAULT_REGION": "us-east-1"}
        s3fs.S3FileSystem(endpoint_url=address).mkdir(BUCKET)
        yield address
    finally:
        server.stop()


def queue(clone: Path, target: list[str]) -> dict[str, Any]:
    """Run experiments with two workers of `dvc queue`: successes, executed stages and whether params.yaml stays."""
    params = (clone / "params.yaml").read_bytes()
    names = [f"queued{k}" for k in range(len(QUEUED))]
    for name, override in zip(names, QUEUED, strict=True):
        dvc(clone, "exp", "run", "--queue", "--name", name, "-S", override, *target)
    os.environ["OMP_NUM_THREADS"] = "1"  # each worker has one core
    started = time.monotonic()
    if "Started '2'" not in (answer := dvc(clone, "queue", "start", "-j", "2")):  # it succeeds without workers too
        raise RuntimeError(f"dvc queue start: expected 2 workers, got {answer!r}; the workers need `dvc` in PATH")
    while "Queued" in (status := dvc(clone, "queue", "status")) or "Running" in status:
        time.sleep(POLL_S)
    seconds = round(time.monotonic() - started)
    dvc(clone, "queue", "stop")
    ran = [executed(dvc(clone, "queue", "logs", name)) for name in names]
    locks = [yaml.safe_load(run(clone, "git", "show", f"{name}:dvc.lock")) for name in experiments(clone, names)]
    scenes = {lock["stages"]["synthesize"]["outs"][1]["md5"] for lock in locks}
    return {
        "experiments": len(QUEUED),
        "succeeded": status.count("Success"),
        "seconds": seconds,
        "executed": sorted(set().union(*ran)),
        "scenes_differ": len(scenes) == len(QUEUED),
        "params_unchanged": (clone / "params.yaml").read_bytes() == params,
    }


def experiments(clone: Path, names: list[str]) -> list[str]:
    """Git references of the experiments of these names."""
    lines = run(clone, "git", "for-each-ref", "--format=%(refname)", "refs/exps").split()
    return [next(line for line in lines if line.endswith(f"/{name}")) for name in names]


STUDIES = {"push": push, "queue": queue}


def main() -> None:
    """Run the studies in one clone, print and perhaps write."""
    parser = command_line(__doc__, "docs/results/sweeps.json")
    parser.add_argument("studies", nargs="+", choices=tuple(STUDIES))
    parser.add_argument("--target", nargs=1, default=[], metavar="STAGE", help="last stage that runs; default: all")
    options: argparse.Namespace = arguments_of(parser)
    record = machine_record(ROOT)
    with tempfile.TemporaryDirectory() as folder:
        clone = reproduced(Path(folder), options.target)
        for name in options.studies:
            figures = STUDIES[name](clone, options.target) | {"target": "".join(options.target) or "all"}
            print(json.dumps({name: figures}, indent=2), flush=True)
            if options.write:
                print(f"wrote {write_section(ROOT, 'sweeps', name, figures, record)}")


if __name__ == "__main__":
    main()
