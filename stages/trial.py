"""One point of a sweep: train and benchmark in the job's own folder, without touching the files that DVC tracks.

`python -m stages.trial -m loss.mse=1.0 loss.ssim=0.0,1.0 seed=1,2,3` runs every combination and ends with one table
(polarnet.config.sweep). A point uses the pipeline's sequences where they were made with its values, and else makes its
own. A failed point writes the reason to `failure.txt`; the others continue. The same command with the same
`hydra.sweep.dir` runs a point again unless its values, its inputs and the code are those of today.
"""

import contextlib
import dataclasses
import functools
import io
import os
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from polarnet.config.benchmark_tables import collect_rows
from polarnet.config.origins import Run, Stage, digest
from polarnet.config.sweep import FAILURE, mark_finished, why_unfinished
from polarnet.config.tree import Config, hydra_command, or_exit, typed
from polarnet.runtime.files import claimed, code_digest
from polarnet.runtime.machine import end_with_parent

# The trained network and the references for it; no other method of the benchmark depends on the training.
REFERENCE_METHODS = ["zeros", "train_mean", "oracle_mean", "ours"]
HINTS = ("Set the environment variable HYDRA_FULL_ERROR", "See https://hydra.cc")  # last lines after Hydra's messages
POINT = "point"  # name of the file of a point's values, which its stages read
ROOT = Path(__file__).resolve().parent.parent
OWN = ("train", "train_baseline", "benchmark")  # stages that every point runs for itself
CHANGES_NO_RESULT = ("paths", "runtime", "cluster", "row", "baseline")


@hydra_command
def main(node: DictConfig) -> None:
    """Run the stages of this point as child processes, unless its folder holds their results already."""
    hydra = HydraConfig.get()
    job = Path(hydra.runtime.output_dir)
    if not any(override.startswith("benchmark.methods=") for override in hydra.overrides.task):
        node.benchmark.methods = REFERENCE_METHODS
    with contextlib.ExitStack() as held:
        or_exit(lambda: held.enter_context(claimed(job)))
        (job / FAILURE).unlink(missing_ok=True)
        failure = _failure_of_point(node, job)
    if failure:
        (job / FAILURE).write_text(f"{failure}\n")
        print(f"{job}: {failure}", file=sys.stderr)
        if hydra.mode == RunMode.RUN:  # in a multirun the sweep table reports it and sets the exit status
            raise SystemExit(1)


def _failure_of_point(node: DictConfig, job: Path) -> str | None:
    """Run a point; return why it failed, or None."""
    try:
        config = typed(node)
    except ValueError as error:
        return str(error)
    run = Run(ROOT, config, "trial")
    plan, inputs = _plan(run)
    values = {name: value for name, value in dataclasses.asdict(config).items() if name not in CHANGES_NO_RESULT}
    digests = {dep: digest(config.place(dep)) for dep in inputs}
    record = {"values": values, "inputs": digests, "code": code_digest()}
    reason = why_unfinished(job, record)
    if reason is None:
        print(f"{job} is finished already")
        return None
    print(f"{job} runs: {reason}")
    point: Any = OmegaConf.to_container(node, resolve=True)
    for out in (Path(out).relative_to("data").parts[0] for stage in plan for out in stage.outs):
        point["paths"][out.removesuffix(".zarr")] = str(job / out)
    OmegaConf.save(OmegaConf.create(point), job / f"{POINT}.yaml")
    for command, name in _commands(plan, config):
        logs = f"hydra.run.dir={quoted(str(job / 'logs' / name))}"
        module, overrides = command[:2], command[2:]  # Hydra takes options before overrides only
        point_file = [f"--config-dir={job}", f"--config-name={POINT}"]
        failure = _failure([sys.executable, *module, *point_file, *overrides, logs])
        if failure:
            return f"{name}: {failure}"
    collect_rows(typed(OmegaConf.create(point)))
    mark_finished(job, record)
    return None


def _plan(run: Run) -> tuple[list[Stage], list[str]]:
    """Stages that a point runs, in order, and the artefacts of the pipeline that it reads.

    The point makes what it needs and the pipeline has made with other values, or not at all.
    """
    wanted = {f"benchmark@{row}" for row in run.config.benchmark.methods} | {"train"}
    for stage in reversed(run.pipeline.values()):
        if stage.name in wanted:
            wanted |= {maker.name for dep in stage.deps if (maker := run.maker_of(dep))}
    plan: list[Stage] = []
    inputs: dict[str, None] = {}
    for stage in run.pipeline.values():
        if stage.name not in wanted:
            continue
        made = {dep: maker for dep in stage.deps if (maker := run.maker_of(dep))}
        follows = any(maker in plan for maker in made.values())
        if follows or stage.name.partition("@")[0] in OWN or run.is_stale(stage):
            plan.append(stage)
            inputs |= dict.fromkeys(dep for dep, maker in made.items() if maker not in plan)
    return plan, list(inputs)


def _commands(plan: Sequence[Stage], config: Config) -> list[tuple[list[str], str]]:
    """Command and name of each process: one for each stage, and one for all rows."""
    commands = [(stage.command[1:], stage.name) for stage in plan if stage.script != "row"]
    return [*commands, (["-m", "stages.row"], "benchmark")]


def quoted(value: str) -> str:
    """A value of an override that Hydra takes as it is, whatever characters it has."""
    return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _failure(command: Sequence[str]) -> str | None:
    """Run a command, passing its errors on as they arrive; return its message if it fails, None if it succeeds."""
    lines: deque[str] = deque(maxlen=20)
    bound = functools.partial(end_with_parent, os.getpid())
    with subprocess.Popen(command, stderr=subprocess.PIPE, preexec_fn=bound) as child:
        assert child.stderr is not None
        for line in io.TextIOWrapper(child.stderr, errors="replace", newline=""):  # progress bars end lines with \r
            print(line, end="", file=sys.stderr, flush=True)
            if line.strip() and not line.startswith(HINTS):
                lines.append(line.strip())
    if child.returncode < 0:
        return f"killed by signal {-child.returncode}"
    return (lines[-1] if lines else f"exit status {child.returncode}") if child.returncode else None


if __name__ == "__main__":
    main()
