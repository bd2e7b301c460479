"""Test sequences, every method -> data/benchmark: the table, a row per frame, and windows to look at."""

import dataclasses
import json
from pathlib import Path

from polarnet.config import Config, hydra_stage
from polarnet.evaluation.benchmark import run_benchmark, train_mean_dolp, write_benchmark
from polarnet.evaluation.methods import Context, available, checkpoints_of, weights_used
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
        postprocessing=config.baselines.postprocessing,
        gain=config.baselines.gain,
        **checkpoints_of(
            config.baselines.weights,
            Path(config.paths.train),
            Path(config.paths.train_e2v),
            Path(config.paths.train_e2p),
        ),
        device=device_of(config.runtime),
        precision=config.benchmark.precision,
    )
    lpips = Lpips.load(config.paths.weights)
    methods, left_out = available(config.benchmark.methods, context)
    for method, reason in left_out.items():
        print(f"{method} is left out: {reason}")
    settings = dataclasses.replace(config.benchmark, methods=methods)
    benchmark = run_benchmark(EventStore.open(config.paths.events), frames, context, settings, lpips)
    weights = json.loads((Path(config.paths.weights) / "lpips.json").read_text())
    folder = Path(config.paths.benchmark)
    about = {
        "lpips": weights,
        "train_mean": train_mean,
        "left_out": left_out,
        "weights": weights_used(methods, context),
        "postprocessing": dataclasses.asdict(context.postprocessing),
    }
    metrics = write_benchmark(folder, benchmark, settings, config.seed, about)
    print(as_plain(score_table(metrics, lpips_reason=weights["reason"])))


if __name__ == "__main__":
    main()
