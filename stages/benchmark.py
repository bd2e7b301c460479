"""Test sequences, all methods -> data/benchmark: tables, scores of each frame, and example windows."""

from polarnet.config.pipeline import lpips_of, run_pipeline_benchmark
from polarnet.config.tree import Config, hydra_stage, or_exit
from polarnet.reports.tables import as_plain, score_table


@hydra_stage
def main(config: Config) -> None:
    """Run every method, score its predictions and print the table."""
    lpips = or_exit(lambda: lpips_of(config))
    for name, metrics in run_pipeline_benchmark(config, lpips).items():
        print(f"\ntest set {name}\n" + as_plain(score_table(metrics)))


if __name__ == "__main__":
    main()
