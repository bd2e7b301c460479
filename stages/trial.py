"""One point of a sweep: train and benchmark in the job's own folder, without touching the files that DVC tracks.

`python -m stages.trial -m loss.mse=1.0 loss.ssim=0.0,1.0 seed=1,2,3` runs every combination on the pipeline's existing
sequences and ends with one table (polarnet.config.sweep). Jobs may run in parallel.

A failed point writes the reason to `failure.txt`; the other points continue. The same command with the same
`hydra.sweep.dir` continues an interrupted sweep: a point whose folder is finished is not run again.
"""

import io
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from polarnet.config.sweep import FAILURE, finished, mark_finished
from polarnet.config.tree import hydra_command
from polarnet.runtime.machine import end_with_parent

# The trained network and the references for it; no other method of the benchmark depends on the training.
REFERENCE_METHODS = "benchmark.methods=[zeros,train_mean,oracle_mean,ours]"
HYDRAS_HINT = "Set the environment variable HYDRA_FULL_ERROR"  # last line after each traceback


@hydra_command
def main(node: DictConfig) -> None:
    """Run the train and benchmark stages as child processes with this job's overrides and folder.

    The child processes check the configuration, so a refused value makes the point a failed point of the sweep.
    """
    hydra = HydraConfig.get()
    job = Path(hydra.runtime.output_dir)
    overrides = list(hydra.overrides.task)
    if not any(override.startswith("benchmark.methods=") for override in overrides):
        overrides.append(REFERENCE_METHODS)
    if finished(job, overrides):
        print(f"{job} is finished already")
        return
    (job / FAILURE).unlink(missing_ok=True)
    failure = None
    for stage in ("train", "benchmark"):
        folders = [f"paths.{name}={job / name}" for name in ("train", "benchmark")]
        logs = [f"hydra.run.dir={job / 'logs' / stage}"]
        failure = _failure([sys.executable, "-m", f"stages.{stage}", *overrides, *folders, *logs])
        if failure:
            (job / FAILURE).write_text(f"{stage}: {failure}\n")
            break
    else:
        mark_finished(job, overrides)
    if failure and hydra.mode == RunMode.RUN:  # in a multirun the sweep table reports it and sets the exit status
        raise SystemExit(1)


def _failure(command: Sequence[str]) -> str | None:
    """Run a command, passing its errors on as they arrive; return the last line if it fails, None if it succeeds."""
    lines: deque[str] = deque(maxlen=20)
    with subprocess.Popen(command, stderr=subprocess.PIPE, preexec_fn=end_with_parent) as child:
        assert child.stderr is not None
        for line in io.TextIOWrapper(child.stderr, errors="replace", newline=""):  # progress bars end lines with \r
            print(line, end="", file=sys.stderr, flush=True)
            if line.strip() and not line.startswith(HYDRAS_HINT):
                lines.append(line.strip())
    if child.returncode < 0:
        return f"killed by signal {-child.returncode}"
    return (lines[-1] if lines else f"exit status {child.returncode}") if child.returncode else None


if __name__ == "__main__":
    main()
