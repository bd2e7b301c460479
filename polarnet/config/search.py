"""A search with Optuna over trials: each runs in a process and a folder of its own, and a hopeless one is stopped."""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from polarnet.config.sweep import FAILURE
from polarnet.runtime.machine import end_with_parent
from polarnet.terminal.installation import installation
from polarnet.training.engine.history import HISTORY, best_row, read_history

if TYPE_CHECKING:
    import optuna

POLL_S = 0.5
STOP_S = 10.0
"""Seconds that a stopped trial has to end before it is killed."""
STUDY = "search.db"
"""File in the folder of a search with its trials, from which it continues."""

Draw = Callable[["optuna.Trial"], Any]


def parse_space(words: Iterable[str]) -> dict[str, Draw]:
    """Search space from words KEY=A,B,C (one of them) or KEY=LOW:HIGH or KEY=LOW:HIGH:log; ValueError for others."""
    return {key: _draw(key, values) for key, _, values in (word.partition("=") for word in words)}


def _draw(key: str, values: str) -> Draw:
    if "," in values:
        choices = values.split(",")
        return lambda trial: trial.suggest_categorical(key, choices)
    low, _, rest = values.partition(":")
    high, _, scale = rest.partition(":")
    try:
        bounds = float(low), float(high)
    except ValueError:
        bounds = (1.0, 0.0)
    if scale not in ("", "log") or not bounds[0] < bounds[1] or (scale == "log" and bounds[0] <= 0):
        raise ValueError(f"{key}={values}: expected A,B,C or LOW:HIGH or LOW:HIGH:log with LOW < HIGH (log: LOW > 0)")
    return lambda trial: trial.suggest_float(key, *bounds, log=scale == "log")


def search(
    command: Sequence[str],
    space: Mapping[str, Draw],
    fixed: Sequence[str],
    folder: Path,
    trials: int,
    jobs: int,
    seed: int,
) -> int:
    """Run trials until `trials` have ended, `jobs` at a time; returns how many this call ran.

    A trial runs `command`, the overrides `fixed` and its drawn ones, with `hydra.run.dir` as its folder, and is judged
    by the smallest validation MSE of its epochs. After each epoch, the median of the trials so far decides whether it
    is stopped. A search in a folder with trials continues it: trials that were interrupted run again. A trial that
    fails or is stopped has the reason in `failure.txt`. RuntimeError without Optuna.
    """
    try:
        import optuna
    except ImportError:
        raise RuntimeError(f"a search needs Optuna: {installation('sweep')}") from None
    folder.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        storage=f"sqlite:///{folder / STUDY}",
        study_name="search",
        load_if_exists=True,
        sampler=optuna.samplers.TPESampler(seed=seed),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=3),
    )
    running, waiting = (optuna.trial.TrialState.RUNNING, optuna.trial.TrialState.WAITING)
    for trial in study.get_trials(states=[running]):
        study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
        study.enqueue_trial(trial.params, user_attrs={"again": trial.number})
    again = {trial.user_attrs.get("again") for trial in study.get_trials()}
    ended = [one for one in study.get_trials() if one.state != waiting and one.number not in again]
    left = max(0, trials - len(ended))

    def objective(trial: "optuna.Trial") -> float:
        drawn = [f"{key}={draw(trial)}" for key, draw in space.items()]
        return run_trial([*command, *fixed, *drawn], folder / str(trial.number), trial)

    study.optimize(objective, n_trials=left, n_jobs=jobs, catch=(RuntimeError,))
    return left


def run_trial(command: Sequence[str], job: Path, trial: "optuna.Trial") -> float:
    """Run one trial in the folder `job`; returns its smallest validation MSE.

    Raises optuna.TrialPruned for a trial that was stopped, RuntimeError for one that failed.
    """
    import optuna

    job.mkdir(parents=True, exist_ok=True)
    training, reported = job / "train" / "ours", 0
    with (job / "output.log").open("w") as log:
        process = subprocess.Popen(
            [*command, f"hydra.run.dir={job}"], stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
            preexec_fn=end_with_parent,
        )  # fmt: skip
        try:
            while process.poll() is None:
                time.sleep(POLL_S)
                for row in _epochs(training)[reported:]:
                    trial.report(row["val"]["mse"], row["epoch"])
                    reported += 1
                    if trial.should_prune():
                        (job / FAILURE).write_text(f"stopped after epoch {row['epoch'] + 1}: worse than the median\n")
                        raise optuna.TrialPruned
        finally:
            _stop(process)
    if process.returncode:
        raise RuntimeError(f"trial {trial.number} failed; {job / FAILURE} and {job / 'output.log'} say why")
    return best_row(read_history(training))["val"]["mse"]


def _epochs(training: Path) -> Sequence[Mapping[str, Any]]:
    """Epochs so far; none while the file is missing or half written."""
    try:
        return read_history(training) if (training / HISTORY).exists() else []
    except (ValueError, TypeError, KeyError):
        return []


def _stop(process: subprocess.Popen) -> None:
    """End a trial and the stages that it started."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
