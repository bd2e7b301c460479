"""data/calibrated -> data/benchmark_recordings: the benchmark's table on real targets."""

from pathlib import Path

from polarnet.benchmarking import lpips_record, made_set, run_on
from polarnet.config import Config, hydra_stage
from polarnet.recordings.status import start_over
from polarnet.reports.tables import as_plain, score_table


@hydra_stage
def main(config: Config) -> None:
    """Recover, score, print: as the stage `benchmark`, whose networks and training mean these are."""
    folder = Path(config.paths.benchmark_recordings)
    start_over(folder, enabled=config.recordings.enabled)
    if not config.recordings.enabled:
        print("recordings.enabled is false")
        return
    metrics = run_on(config, made_set("recordings", Path(config.paths.calibrated)), folder)
    print(as_plain(score_table(metrics, lpips_reason=lpips_record(config)["reason"])))


if __name__ == "__main__":
    main()
