"""data/scenes.zarr -> data/events.zarr: events of a camera behind each of the four polarizers."""

from pathlib import Path

from polarnet.config.tree import Config, hydra_stage
from polarnet.runtime.machine import threads_of
from polarnet.simulation.dataset import emulate_scenes


@hydra_stage
def main(config: Config) -> None:
    """Emulate every sequence that is missing from the event store."""
    scenes, events = Path(config.paths.scenes), Path(config.paths.events)
    mapper, threads = config.mapper("emulate"), threads_of(config.runtime)
    count = emulate_scenes(scenes, events, config.camera, config.seed, mapper, threads, config.storage.labels)
    print(f"{count} sequences")


if __name__ == "__main__":
    main()
