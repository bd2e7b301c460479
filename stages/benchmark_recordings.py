"""data/calibrated -> data/benchmark_recordings: the benchmark's table on real targets."""

import json
from pathlib import Path

from polarnet.config import Config, hydra_stage
from polarnet.evaluation.benchmark import run_benchmark, train_mean_dolp, write_benchmark
from polarnet.evaluation.methods import Context
from polarnet.events.frames import FrameStore
from polarnet.events.store import EventStore
from polarnet.recordings.status import start_over
from polarnet.reports.tables import as_plain, score_table
from polarnet.runtime import device_of
from polarnet.similarity import Lpips


@hydra_stage
def main(config: Config) -> None:
    """Recover, score, print: as the stage `benchmark`, whose networks and training mean these are."""
    folder, calibrated = Path(config.paths.benchmark_recordings), Path(config.paths.calibrated)
    start_over(folder, enabled=config.recordings.enabled)
    if not config.recordings.enabled:
        print("recordings.enabled is false")
        return
    train_mean = train_mean_dolp(FrameStore.open(config.paths.frames), config.benchmark.warmup_windows)
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
    events, frames = EventStore.open(calibrated / "events.zarr"), FrameStore.open(calibrated / "frames.zarr")
    benchmark = run_benchmark(events, frames, context, config.benchmark, lpips)
    weights = json.loads((Path(config.paths.weights) / "lpips.json").read_text())
    about = {"lpips": weights, "train_mean": train_mean}
    metrics = write_benchmark(folder, benchmark, config.benchmark, config.seed, about)
    print(as_plain(score_table(metrics, lpips_reason=weights["reason"])))


if __name__ == "__main__":
    main()
