"""Result files of the whole table: scores, costs, details, scores of every frame, and panels of one test set."""

import dataclasses
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from polarnet.benchmark.paired import paired_comparisons
from polarnet.benchmark.run import Benchmark
from polarnet.benchmark.score import METRICS, BenchmarkConfig, scene_means, summary, write_frames
from polarnet.storage.panels import write_panel


def write_benchmark(
    folder: Path, benchmark: Benchmark, config: BenchmarkConfig, seed: int, about: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Write metrics.json, cost.json, details.json (`about`, settings), frames.csv and panels/SEQUENCE.npz.

    Metrics depend on the settings and the seed alone; costs depend on the machine. Returns both, by method.
    """
    shutil.rmtree(folder / "panels", ignore_errors=True)  # an earlier run may have saved other scenes
    (folder / "panels").mkdir(parents=True)
    backbone = {"lpips_backbone": config.lpips_backbone} if config.lpips else {}
    scores = summary(benchmark.rows, config.bootstrap_samples, seed)
    metrics: dict[str, dict[str, Any]] = {method: {**scores[method], **backbone} for method in scores}
    costs = {method: dataclasses.asdict(benchmark.costs[method]) for method in scores}
    means = {metric: scene_means(benchmark.rows, metric) for metric in METRICS}
    details = {
        **about,
        "scenes": sorted({row.scene for row in benchmark.rows}),
        "sequences": sorted({row.sequence for row in benchmark.rows}),
        "frames": len(benchmark.rows) // len(config.methods),
        "warmup_windows": config.warmup_windows,
        "precision": config.precision,
        "bootstrap_samples": config.bootstrap_samples,
        "scene_means": {metric: of_methods for metric, of_methods in means.items() if of_methods},
        "paired": paired_comparisons(benchmark.rows, "ours"),
        "reliability": {
            method: {"curve": sums.curve(), "log_error": sums.log_error()}
            for method, sums in benchmark.reliability.items()
        },
    }
    for name, content in (("metrics", metrics), ("cost", costs), ("details", details)):
        (folder / f"{name}.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    write_frames(folder / "frames.csv", benchmark.rows)
    for panel in benchmark.panels:
        write_panel(folder / "panels", panel)
    return {method: {**metrics[method], **costs[method]} for method in metrics}
