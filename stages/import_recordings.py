"""data/recordings -> data/imported: the eight decoded captures of every real target, if recordings are enabled."""

from pathlib import Path

from polarnet.captures.targets import import_targets, start_over
from polarnet.config.tree import Config, hydra_stage, input_folder


@hydra_stage
def main(config: Config) -> None:
    """Decode every target, or report that recordings are switched off."""
    out = Path(config.paths.imported)
    if not config.recordings.enabled:
        start_over(out, enabled=False)
        print("recordings.enabled is false")
        return
    root = input_folder("recordings.root", config.recordings.root)
    names = import_targets(root, out, config.recordings)
    print(f"{len(names)} targets: {', '.join(names)}")


if __name__ == "__main__":
    main()
