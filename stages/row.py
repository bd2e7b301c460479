"""Test sequences -> data/benchmark/rows/ROW: a row of the tables on every test set (`row=ROW`).

`python -m stages.row` runs every row of `benchmark.methods` in one pass over the events; DVC runs the rows one by one.
"""

from polarnet.config.pipeline import run_rows
from polarnet.config.tree import Config, hydra_stage


@hydra_stage
def main(config: Config) -> None:
    """Run and score the rows, or record why one is left out."""
    run_rows(config, [config.row] if config.row else config.benchmark.methods)


if __name__ == "__main__":
    main()
