"""Test sequences, all methods -> data/benchmark: every row in one pass, and the tables; DVC runs rows one by one."""

from polarnet.config.pipeline import run_rows, set_folder
from polarnet.config.tables import collect_rows
from polarnet.config.tree import Config, hydra_stage
from polarnet.reports.artefacts import read_results, results_table
from polarnet.reports.tables import as_plain


@hydra_stage
def main(config: Config) -> None:
    """Run every row of `benchmark.methods`, score its predictions and print the table."""
    run_rows(config, config.benchmark.methods)
    for name in collect_rows(config):
        print(f"\ntest set {name}\n" + as_plain(results_table(read_results(set_folder(config, name)))))


if __name__ == "__main__":
    main()
