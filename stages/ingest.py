"""Photographs and generated pictures -> data/images: RGB pictures of one size, assigned to splits."""

from pathlib import Path

from polarnet.config.tree import Config, hydra_stage, input_folder
from polarnet.pictures.ingest import ingest


@hydra_stage
def main(config: Config) -> None:
    """Fill data/images and print a summary of its content."""
    if config.ingest.source != "builtin":
        input_folder("ingest.root", config.ingest.root)
    manifest = ingest(config.ingest, config.seed, Path(config.paths.images), config.mapper("ingest"))
    print(", ".join(f"{count} {name.replace('_', ' ')}" for name, count in manifest.counts.items()))


if __name__ == "__main__":
    main()
