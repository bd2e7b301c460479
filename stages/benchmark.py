"""Test sequences, every method -> data/benchmark: the tables, a row per frame, and windows to look at."""

from polarnet.benchmarking import lpips_record, run_pipeline_benchmark
from polarnet.config import Config, hydra_stage
from polarnet.reports.tables import as_plain, score_table


@hydra_stage
def main(config: Config) -> None:
    """Recover, score, print."""
    for name, metrics in run_pipeline_benchmark(config).items():
        print(f"\ntest set {name}\n" + as_plain(score_table(metrics, lpips_reason=lpips_record(config)["reason"])))


if __name__ == "__main__":
    main()
