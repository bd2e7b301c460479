"""Table and plot at the end of a Hydra multirun of trials: points ranked by validation MSE, seeds averaged."""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from polarnet.config.origins import first_difference
from polarnet.training.engine.recorder import HISTORY, best_row, read_history

FAILURE = "failure.txt"
"""File in the folder of a failed job with the reason in one line."""
FINISHED = "finished.json"
"""File in the folder of a finished job with all of its values, and hashes of its inputs."""
SCORES = [("validation", name) for name in ("mse", "psnr")]
SCORES += [("test", name) for name in ("mse", "psnr", "ssim", "lpips", "corr")]
"""Split and name of each score of a point; test scores rank nothing."""


class SweepTable(Callback):
    """Writes comparison.csv and comparison.png into the sweep's folder and prints the ranking (conf/config.yaml)."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Collect the trials and write their table; a sweep of another entry point has no trials and gets no table.

        Raises SystemExit if a point failed, the only exception of a callback with which Hydra ends the sweep.
        """
        folder = Path(config.hydra.sweep.dir)
        points = sweep_points(folder)
        if not points:
            return
        rows = sweep_rows(points)
        write_csv(rows, folder / "comparison.csv")
        if axes := swept_axes(rows):
            # every stage imports this module, and only a sweep draws
            from polarnet.reports.charts import parallel_coordinates
            from polarnet.reports.maps import png

            (folder / "comparison.png").write_bytes(png(parallel_coordinates(*axes, "validation MSE")))
        print(f"\n{ranking(rows)}\n{best_point(rows)}\nAll scores: {folder / 'comparison.csv'}")
        if failed := sum(point["failure"] is not None for point in points):
            raise SystemExit(f"{failed} of {len(points)} points failed; the table has their reasons")


def why_unfinished(job: Path, record: Mapping[str, Any]) -> str | None:
    """Why the folder of a job does not hold the results of `record`, its values and inputs; None if it does."""
    before = _read(job / FINISHED)
    if before is None:
        return "it has not finished"
    change = first_difference(before, json.loads(json.dumps(record)), "")
    return change and f"{change[0]} was {change[1]}, is {change[2]}"


def mark_finished(job: Path, record: Mapping[str, Any]) -> None:
    """Record that the folder of a job holds the results of these values and inputs."""
    (job / FINISHED).write_text(json.dumps(record) + "\n")


def sweep_points(folder: Path) -> list[dict[str, Any]]:
    """Trials of a sweep in the order of the jobs: overrides, seed, scores and the reason of a failure.

    `validation` holds the scores of the best epoch, and `test` holds those of `ours`; None if a trial has none.
    """
    jobs = [path.parent.parent for path in folder.glob("**/.hydra/overrides.yaml")]
    trials = [job for job in jobs if (job / "train").exists() or (job / FAILURE).exists()]
    return [_point(folder, job) for job in sorted(trials, key=lambda job: (len(job.name), job.name))]


def _point(folder: Path, job: Path) -> dict[str, Any]:
    training, metrics = job / "train" / "ours", _read(job / "benchmark" / "metrics.json")
    unfinished = None if metrics else "it did not finish"
    return {
        "job": job.relative_to(folder).as_posix(),
        "overrides": list(OmegaConf.load(job / ".hydra" / "overrides.yaml")),
        "seed": OmegaConf.load(job / ".hydra" / "config.yaml").seed,
        "validation": best_row(read_history(training))["val"] if (training / HISTORY).exists() else None,
        "test": metrics["simulated"]["ours"] if metrics else None,
        "failure": (job / FAILURE).read_text().strip() if (job / FAILURE).exists() else unfinished,
    }


def sweep_rows(points: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Merge points that differ only in the seed into one row, and sort the rows by validation MSE.

    The smallest MSE comes first, and rows without MSE come last. A row has SPLIT_SCORE, the mean over seeds, and
    SPLIT_SCORE_std, the standard deviation (None for one seed), of each score that all of its trainings have.
    """
    groups: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for point in points:
        groups.setdefault(tuple(one for one in point["overrides"] if not one.startswith("seed=")), []).append(point)
    rows: list[dict[str, Any]] = []
    for overrides, group in groups.items():
        finished, failed = ([point for point in group if bool(point["failure"]) == bad] for bad in (False, True))
        row: dict[str, Any] = {"jobs": [point["job"] for point in group], "overrides": list(overrides)}
        row |= {"seeds": [one["seed"] for one in finished], "failed_seeds": [one["seed"] for one in failed]}
        for split, name in SCORES:
            values = [point[split].get(name) for point in finished]
            known = bool(values) and None not in values
            row[f"{split}_{name}"] = fmean(values) if known else None
            row[f"{split}_{name}_std"] = stdev(values) if known and len(values) > 1 else None
        rows.append(row | {"notes": [f"seed {one['seed']} failed: {one['failure']}" for one in failed]})
    return sorted(rows, key=lambda row: float("inf") if row["validation_mse"] is None else row["validation_mse"])


def best_point(rows: Sequence[Mapping[str, Any]]) -> str:
    """One sentence on the first of `sweep_rows`, with the 95 % interval of the mean over seeds (Student's t)."""
    from scipy.stats import t  # slow to import

    best = rows[0]
    mean, std, count = best["validation_mse"], best["validation_mse_std"], len(best["seeds"])
    if mean is None:
        return "No point finished."
    shared = shared_overrides(rows)
    own = " ".join(one for one in best["overrides"] if one not in shared)
    words = f"Best: {own or 'the settings of params.yaml'}, validation MSE {mean:.4f}"
    if std is None:
        return f"{words}, of one seed; sweep over seed=1,2,3 for an interval."
    half = float(t.ppf(0.975, count - 1)) * std / count**0.5
    return f"{words}, 95 % interval over {count} seeds {mean - half:.4f} to {mean + half:.4f}."


def shared_overrides(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Overrides that all of several `sweep_rows` have; none of a single row."""
    first, *others = (row["overrides"] for row in rows)
    return [one for one in first if others and all(one in overrides for overrides in others)]


def swept_axes(rows: Sequence[Mapping[str, Any]]) -> tuple[dict[str, list[str]], list[float]] | None:
    """Values of the keys that differ between finished rows, and their validation MSE; None if no key differs."""
    done = [row for row in rows if row["validation_mse"] is not None]
    given = [dict(one.lstrip("+").split("=", 1) for one in row["overrides"]) for row in done]
    values = {key: [one.get(key, "-") for one in given] for key in dict.fromkeys(key for one in given for key in one)}
    differing = {key: column for key, column in values.items() if len(set(column)) > 1}
    return (differing, [row["validation_mse"] for row in done]) if differing else None


def ranking(rows: Sequence[Mapping[str, Any]]) -> str:
    """`sweep_rows` as lines: validation and test MSE, seeds, the overrides that not all rows share, and failures."""
    shared = shared_overrides(rows)
    lines = [f"{'validation MSE':>19}  {'test MSE':>19}  seeds   overrides"]
    for row in rows:
        finished, failed = len(row["seeds"]), len(row["failed_seeds"])
        validation, test = (_printed(row[f"{split}_mse"], row[f"{split}_mse_std"]) for split in ("validation", "test"))
        seeds = f"{finished} of {finished + failed}" if failed else f"{finished}"
        own = " ".join(one for one in row["overrides"] if one not in shared)
        lines.append(f"{validation:>19}  {test:>19}  {seeds:<6}  {own}".rstrip())
        lines += [f"    {note}" for note in row["notes"]]
    return "\n".join([*lines, *([f"All have {' '.join(shared)}."] if shared else [])])


def _printed(mean: float | None, std: float | None) -> str:
    return "-" if mean is None else f"{mean:.4f}" + ("" if std is None else f" ± {std:.4f}")


def write_csv(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write `sweep_rows` as one line each."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        for row in rows:
            lists = {key: " ".join(map(str, value)) for key, value in row.items() if isinstance(value, list)}
            writer.writerow({**row, **lists, "notes": "; ".join(row["notes"])})


def _read(path: Path) -> Any:
    return json.loads(path.read_text()) if path.exists() else None
