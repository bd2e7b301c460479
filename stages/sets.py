"""data/images and measured polarization -> data/sets: all test sets of benchmark.sets except the simulated one."""

import functools
from pathlib import Path

from polarnet.config.tree import Config, hydra_stage, input_folder
from polarnet.runtime.cluster import pmap
from polarnet.runtime.machine import threads_of
from polarnet.simulation.sets import Recipe, make_complex_motion, make_folder_set


@hydra_stage
def main(config: Config) -> None:
    """Make every requested set that does not exist yet."""
    folder = Path(config.paths.sets)
    folder.mkdir(parents=True, exist_ok=True)
    threads, size = threads_of(config.runtime), config.storage.sequences_per_part
    recipe = Recipe(config.ingest, config.synthesize, config.emulate, config.seed, threads, size)

    def mapper(label: str) -> functools.partial:
        return functools.partial(pmap, workers=config.runtime.workers, label=label, address=config.cluster.address)

    if "complex_motion" in config.benchmark.sets:
        make_complex_motion(Path(config.paths.images), folder / "complex_motion", config.sets, recipe, mapper)
    if "measured" in config.benchmark.sets:
        root = input_folder("sets.measured_root", config.sets.measured_root)
        make_folder_set(root, "polarization", folder / "measured", recipe, mapper)
    made = [name for name in config.benchmark.sets if name != "simulated"]
    print(f"test sets beyond simulated: {', '.join(made) or 'none asked for'}")


if __name__ == "__main__":
    main()
