"""data/images -> data/scenes.zarr, data/frames.zarr: polarized scenes, sensor motions and exact frames."""

from pathlib import Path

from polarnet.config.tree import Config, hydra_stage
from polarnet.simulation.truth import Synthesis, synthesize


@hydra_stage
def main(config: Config) -> None:
    """Make a scene from every picture and move the sensor over it."""
    images, size = Path(config.paths.images), config.storage.sequences_per_part
    synthesis = Synthesis(images, config.synthesize, config.seed, size, config.variation, config.polarizers)
    count = synthesize(synthesis, config.paths.scenes, config.paths.frames, config.mapper("synthesize"))
    print(f"{count} sequences")


if __name__ == "__main__":
    main()
