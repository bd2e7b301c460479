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
    """Writes comparison.csv and comparison.png into the sweep's folder (conf/config.yaml)."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Collect the trials and write their table; a sweep of another entry point has no trials and gets no table.

        Raises SystemExit if a point failed, the only exception of a callback with which Hydra ends the sweep.
        """
        folder = Path(config.hydra.sweep.dir)
        points = sweep_points(folder)
        if not points:
            return
        rows = sweep_rows(points)
        with (folder / "comparison.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
        ranked = [row for row in rows if row["validation_mse"] is not None]
        if ranked:
            # every stage imports this module, and only a sweep draws
            from polarnet.reports.figures import sweep_chart
            from polarnet.reports.maps import png

            drawn = {row["point"]: (row["validation_mse"], row["validation_mse_std"] or 0.0) for row in ranked}
            (folder / "comparison.png").write_bytes(png(sweep_chart(drawn)))
        print(f"scores by validation MSE: {folder / 'comparison.csv'}")
        if failed := sum(point["failure"] is not None for point in points):
            raise SystemExit(f"{failed} of {len(points)} points failed; the table has their reasons")


def why_unfinished(job: Path, record: Mapping[str, Any]) -> str | None:
    """Why the folder of a job does not hold the results of `record`, its values and inputs; None if it does."""
    before = _read(job / FINISHED)
    if before is None:
        return "it has not finished"
    change = first_difference(before, json.loads(json.dumps(record)))
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

    The smallest MSE comes first, and rows without MSE come last. `point` holds the overrides that not all points
    share. A row has SPLIT_SCORE, the mean over seeds, and SPLIT_SCORE_std, the standard deviation (None for one seed),
    of each score that all of its trainings have.
    """
    shared = set.intersection(*(set(point["overrides"]) for point in points)) if len(points) > 1 else set()
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for point in points:
        own = [one for one in point["overrides"] if one not in shared and not one.startswith("seed=")]
        groups.setdefault(" ".join(own), []).append(point)
    rows: list[dict[str, Any]] = []
    for name, group in groups.items():
        finished, failed = ([point for point in group if bool(point["failure"]) == bad] for bad in (False, True))
        row: dict[str, Any] = {"point": name or "params.yaml", "jobs": " ".join(point["job"] for point in group)}
        row["seeds"] = " ".join(str(point["seed"]) for point in finished)
        for split, score in SCORES:
            values = [point[split].get(score) for point in finished]
            known = bool(values) and None not in values
            row[f"{split}_{score}"] = fmean(values) if known else None
            row[f"{split}_{score}_std"] = stdev(values) if known and len(values) > 1 else None
        row["failures"] = "; ".join(f"seed {one['seed']} failed: {one['failure']}" for one in failed)
        rows.append(row)
    return sorted(rows, key=lambda row: float("inf") if row["validation_mse"] is None else row["validation_mse"])


def _read(path: Path) -> Any:
    return json.loads(path.read_text()) if path.exists() else None
