"""benchmark.methods, methods.NAME.weights -> data/baselines: tells DVC whether to train each baseline."""

import json
from pathlib import Path

from polarnet.config.tree import Config, hydra_stage
from polarnet.training.baselines import USERS, is_used


@hydra_stage
def main(config: Config) -> None:
    """Write one file per baseline; the file changes only if the need to train the baseline changes."""
    folder = Path(config.paths.baselines)
    folder.mkdir(parents=True, exist_ok=True)
    for baseline in USERS:
        used = is_used(baseline, config.benchmark.methods, config.methods)
        (folder / f"{baseline}.json").write_text(json.dumps({"trained": used}) + "\n")
        print(f"{baseline}: {'to be trained' if used else 'not trained, since no row of benchmark.methods uses it'}")


if __name__ == "__main__":
    main()
