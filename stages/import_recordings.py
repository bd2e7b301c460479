"""data/recordings -> data/imported: the eight captures of every real target, decoded; nothing while switched off."""

from pathlib import Path

from polarnet.config import Config, hydra_stage
from polarnet.recordings.targets import import_targets, switched_off


@hydra_stage
def main(config: Config) -> None:
    """Decode every target, or say that recordings are switched off."""
    out = Path(config.paths.imported)
    if not config.recordings.enabled:
        switched_off(out)
        print("recordings.enabled is false")
        return
    try:
        names = import_targets(Path(config.recordings.root), out, config.recordings)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    print(f"{len(names)} targets: {', '.join(names)}")


if __name__ == "__main__":
    main()
