"""Test sequences, every method -> data/benchmark: the table, a row per frame, and windows to look at."""

import json
from pathlib import Path

from polarnet.config import Config, hydra_stage
from polarnet.evaluation.benchmark import run_benchmark, train_mean_dolp, write_benchmark
from polarnet.evaluation.methods import Context
from polarnet.events.frames import FrameStore
from polarnet.events.store import EventStore
from polarnet.reports.tables import as_plain, score_table
from polarnet.runtime import device_of
from polarnet.similarity import Lpips


@hydra_stage
def main(config: Config) -> None:
    """Recover, score, print."""
    frames = FrameStore.open(config.paths.frames)
    train_mean = train_mean_dolp(frames, config.benchmark.warmup_windows)
    context = Context(
        train_mean=train_mean,
        cf=config.baselines.cf,
        highpass=config.baselines.highpass,
        e2v_checkpoint=Path(config.paths.train_e2v) / "best.safetensors",
        ours_checkpoint=Path(config.paths.train) / "best.safetensors",
        device=device_of(config.runtime),
        precision=config.benchmark.precision,
    )
    lpips = Lpips.load(config.paths.weights)
    benchmark = run_benchmark(EventStore.open(config.paths.events), frames, context, config.benchmark, lpips)
    weights = json.loads((Path(config.paths.weights) / "lpips.json").read_text())
    folder = Path(config.paths.benchmark)
    metrics = write_benchmark(
        folder, benchmark, config.benchmark, config.seed, {"lpips": weights, "train_mean": train_mean}
    )
    print(as_plain(score_table(metrics, lpips_reason=weights["reason"])))


if __name__ == "__main__":
    main()
