"""Search settings of the training with Optuna: `python -m stages.search loss.mse=1.0:30.0:log network=polarnet,paper`.

Words KEY=A,B,C and KEY=LOW:HIGH[:log] span the space, other words KEY=VALUE are overrides of every trial. Each trial is
`stages.trial`; one that is worse than the median of the others after an epoch is stopped. The same command continues a
search. It ends with the table, the plot and the best point of a sweep.
"""

import argparse
import sys
from pathlib import Path

from polarnet.config.search import parse_space, search
from polarnet.config.sweep import write_comparison


def main() -> None:
    """Run the search and print its table."""
    parser = argparse.ArgumentParser(
        prog="python -m stages.search", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="+", metavar="KEY=VALUES")
    parser.add_argument("--trials", type=int, default=12, help="trials of the whole search (default: 12)")
    parser.add_argument("--jobs", type=int, default=1, help="trials at a time (default: 1)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the search, not of the trainings (default: 1)")
    parser.add_argument("--out", type=Path, default=Path("outputs/searches/default"), metavar="FOLDER")
    options = parser.parse_args()
    ranges = [
        word for word in options.words if any(mark in word.partition("=")[2] for mark in ",:") and "[" not in word
    ]
    fixed = [word for word in options.words if word not in ranges]
    command, folder = [sys.executable, "-m", "stages.trial"], options.out.resolve()
    try:
        count = search(command, parse_space(ranges), fixed, folder, options.trials, options.jobs, options.seed)
    except (ValueError, RuntimeError) as error:
        raise SystemExit(f"stages.search: {error}") from None
    print(f"{count} trials ran now\n{write_comparison(folder)}")


if __name__ == "__main__":
    main()
