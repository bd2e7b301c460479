"""Scenes of the test sets -> data/rotating: events of one camera behind a rotating polarizer, for its row."""

from pathlib import Path

from polarnet.config.tree import Config, hydra_stage
from polarnet.simulation.sets import emulate_scenes

ROTATING = "data/rotating"  # `needs` of a row that sees these events


@hydra_stage
def main(config: Config) -> None:
    """Emulate the test sequences of every set in `benchmark.sets`, or nothing if no row needs them."""
    Path(config.paths.rotating).mkdir(parents=True, exist_ok=True)
    if all(row.needs != ROTATING for row in config.rows.values()):
        print("no row needs the events behind a rotating polarizer")
        return
    sources = {name: Path(config.paths.sets) / name / "scenes.zarr" for name in config.benchmark.sets}
    sources["simulated"] = Path(config.paths.scenes)
    for name, scenes in sources.items():
        events, mapper = Path(config.paths.rotating) / f"{name}.zarr", config.mapper("emulate_rotating")
        count = emulate_scenes(scenes, events, config.camera, config.seed, mapper, 1, config.rotating)
        print(f"{name}: {count} sequences")


if __name__ == "__main__":
    main()
