"""Measured polarization -> data/sets: the test set `measured`, if benchmark.sets names it."""

from pathlib import Path

from polarnet.config.tree import Config, hydra_stage, input_folder
from polarnet.simulation.sets import make_folder_set


@hydra_stage
def main(config: Config) -> None:
    """Make every requested set that does not exist yet."""
    folder = Path(config.paths.sets)
    folder.mkdir(parents=True, exist_ok=True)
    if "measured" in config.benchmark.sets:
        root = input_folder("sets.measured_root", config.sets.measured_root)
        make_folder_set(root, "polarization", folder / "measured", config.recipe, config.mapper)
    names = [name for name in config.benchmark.sets if name != "simulated"]
    print(f"test sets beyond simulated: {', '.join(names) or 'none asked for'}")


if __name__ == "__main__":
    main()
