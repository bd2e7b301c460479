"""Test sequences, all methods -> data/benchmark: every row in one pass, and the tables; DVC runs rows one by one."""

from polarnet.config.pipeline import run_rows
from polarnet.config.tables import collect_rows
from polarnet.config.tree import Config, hydra_stage
from polarnet.reports.tables import as_plain, score_table


@hydra_stage
def main(config: Config) -> None:
    """Run every row of `benchmark.methods`, score its predictions and print the table."""
    run_rows(config, config.benchmark.methods)
    for name, scores in collect_rows(config).items():
        print(f"\ntest set {name}\n" + as_plain(score_table(scores)))


if __name__ == "__main__":
    main()
