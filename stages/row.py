"""Test sequences -> data/benchmark/rows/ROW: one row of the tables on every test set (`row=ROW`)."""

from polarnet.config.pipeline import run_rows
from polarnet.config.tree import Config, hydra_stage


@hydra_stage
def main(config: Config) -> None:
    """Run and score the row, or record why it is left out."""
    if config.row is None:
        raise SystemExit("row: expected the name of a row, got none; `python -m stages.benchmark` runs all")
    run_rows(config, [config.row])


if __name__ == "__main__":
    main()
