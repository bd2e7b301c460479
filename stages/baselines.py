"""benchmark.methods, methods.NAME.weights -> data/baselines: whether each baseline is trained, for DVC to act on."""

import json
from pathlib import Path

from polarnet.config import Config, hydra_stage
from polarnet.training.baselines import USERS, is_used


@hydra_stage
def main(config: Config) -> None:
    """Write a file for each baseline that changes only when its training becomes needed or is needed no more."""
    folder = Path(config.paths.baselines)
    folder.mkdir(parents=True, exist_ok=True)
    for baseline in USERS:
        used = is_used(baseline, config.benchmark.methods, config.methods)
        (folder / f"{baseline}.json").write_text(json.dumps({"trained": used}) + "\n")
        print(f"{baseline}: {'to be trained' if used else 'not trained, since no row of benchmark.methods uses it'}")


if __name__ == "__main__":
    main()
