"""Stages in children of one process that has imported them all, so that a start takes no seconds of imports.

Each stage still reads its command line and runs in a process of its own, without the type checks of pytest.
"""

import multiprocessing
import multiprocessing.forkserver
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

STAGES = sorted(path.stem for path in (Path(__file__).parents[1] / "stages").glob("[a-z]*.py"))
FORKSERVER = multiprocessing.get_context("forkserver")
FORKSERVER.set_forkserver_preload([*(f"stages.{stage}" for stage in STAGES), "distributed"])


def run_stage(
    root: Path, stage: str, arguments: list[str], prepare: Callable[[], None] | None = None
) -> subprocess.CompletedProcess[str]:
    """The exit status and output of `python -m stages.STAGE ARGUMENTS` in `root`; `stdout` holds both streams.

    `prepare` changes the stage's process before the stage starts.
    """
    with tempfile.NamedTemporaryFile(mode="r") as output:
        process = FORKSERVER.Process(target=_main, args=(root, stage, arguments, output.name, prepare))
        process.start()
        process.join()
        return subprocess.CompletedProcess([stage, *arguments], process.exitcode or 0, output.read())


def fork_workers_too() -> None:
    """Let the worker processes of a stage fork from the process that the stage was forked from; a `prepare`."""
    from polarnet.runtime import cluster

    multiprocessing.forkserver._forkserver.ensure_running = lambda: None  # it runs; Python would start another
    cluster.multiprocessing = SimpleNamespace(get_context=lambda _: FORKSERVER)


def _main(root: Path, stage: str, arguments: list[str], output: str, prepare: Callable[[], None] | None) -> None:
    descriptor = os.open(output, os.O_WRONLY | os.O_APPEND)
    for standard in (1, 2):
        os.dup2(descriptor, standard)
    os.chdir(root)
    if prepare:
        prepare()
    sys.argv = [f"stages.{stage}", *arguments]
    __import__(f"stages.{stage}", fromlist=["main"]).main()
