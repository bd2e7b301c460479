"""One table at the end of a Hydra multirun of trials: each point's overrides beside its scores."""

import json
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

COLUMNS = ("mse", "psnr", "ssim", "lpips", "corr")


class SweepTable(Callback):
    """Writes `comparison.md` and `comparison.json` into the sweep's folder and prints the table (conf/config.yaml)."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Gather the benchmark of every job that has one; a sweep of another entry point has none and gets no table."""
        folder = Path(config.hydra.sweep.dir)
        points = sweep_points(folder)
        if not points:
            return
        table = sweep_table(points)
        (folder / "comparison.md").write_text(table + "\n")
        (folder / "comparison.json").write_text(json.dumps(points, indent=2) + "\n")
        print(f"\n{table}\n\nwritten to {folder / 'comparison.md'}")


def sweep_points(folder: Path) -> list[dict[str, Any]]:
    """Job number, overrides and scores of `ours` for each finished job of a sweep, best MSE first."""
    points = []
    for metrics in folder.glob("*/benchmark/metrics.json"):
        job = metrics.parent.parent
        overrides = OmegaConf.load(job / ".hydra" / "overrides.yaml")
        points.append(
            {"job": job.name, "overrides": list(overrides), "scores": json.loads(metrics.read_text())["ours"]}
        )
    return sorted(points, key=lambda point: point["scores"]["mse"])


def sweep_table(points: list[dict[str, Any]]) -> str:
    """A markdown table of `sweep_points`, one row a job."""
    lines = ["| job | overrides | " + " | ".join(COLUMNS) + " |", "|" + "---|" * (2 + len(COLUMNS))]
    for point in points:
        scores = [point["scores"].get(column) for column in COLUMNS]
        cells = ["-" if score is None else f"{score:.4f}" for score in scores]
        lines.append(f"| {point['job']} | {' '.join(point['overrides'])} | {' | '.join(cells)} |")
    return "\n".join(lines)
