"""Test sequences -> data/benchmark/rows/ROW: a row of the tables on every test set (`row=ROW`); or all, and the tables.

`python -m stages.row` runs every row of `benchmark.methods` in one pass over the events and prints the tables; DVC runs
the rows one by one.
"""

from polarnet.config.pipeline import run_rows, set_folder
from polarnet.config.tables import collect_rows
from polarnet.config.tree import Config, hydra_stage
from polarnet.reports.artefacts import read_results, results_table
from polarnet.reports.tables import as_plain


@hydra_stage
def main(config: Config) -> None:
    """Run and score the rows, or record why one is left out."""
    run_rows(config, [config.row] if config.row else config.benchmark.methods)
    if config.row is None:
        for name in collect_rows(config):
            print(f"\ntest set {name}\n" + as_plain(results_table(read_results(set_folder(config, name)))))


if __name__ == "__main__":
    main()
