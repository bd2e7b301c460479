"""data/images -> data/scenes.zarr, data/frames.zarr: polarized scenes, sensor motions and exact frames."""

from pathlib import Path

from polarnet.config.tree import Config, hydra_stage
from polarnet.simulation.truth import synthesize


@hydra_stage
def main(config: Config) -> None:
    """Make a scene from every picture and move the sensor over it."""
    images, scenes, frames = Path(config.paths.images), config.paths.scenes, config.paths.frames
    mapper, size = config.mapper("synthesize"), config.storage.sequences_per_part
    layout = config.polarizers.layout
    count = synthesize(images, scenes, frames, config.synthesize, config.seed, mapper, size, config.variation, layout)
    print(f"{count} sequences")


if __name__ == "__main__":
    main()
