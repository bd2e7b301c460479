"""data/scenes.zarr -> data/events.zarr: events of a camera behind each of the four polarizers."""

from polarnet.config.tree import Config, hydra_stage
from polarnet.runtime.machine import threads_of
from polarnet.simulation.sets import emulate_scenes


@hydra_stage
def main(config: Config) -> None:
    """Emulate every sequence that is missing from the event store."""
    paths, mapper, threads = config.paths, config.mapper("emulate"), threads_of(config.runtime)
    count = emulate_scenes(paths.scenes, paths.events, config.camera, config.seed, mapper, threads)
    print(f"{count} sequences")


if __name__ == "__main__":
    main()
