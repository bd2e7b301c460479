"""The clone around the current folder, and the command that writes its settings: preset."""

import argparse
from pathlib import Path

from polarnet.config.experiments import group_of, write_preset
from polarnet.terminal.installation import shipped_settings


def _clone() -> Path | None:
    here = Path.cwd().resolve()
    files = ("params.yaml", "dvc.yaml")
    return next((path for path in (here, *here.parents) if all((path / file).exists() for file in files)), None)


def settings_root() -> Path:
    """Folder of params.yaml and conf/: the clone at or above the current folder, else those beside the code."""
    return _clone() or shipped_settings()


def working_folder() -> Path:
    """Start of the paths of conf/config.yaml: the clone at or above the current folder, else the current folder."""
    return _clone() or Path.cwd()


def preset(options: argparse.Namespace) -> None:
    """Write a preset into params.yaml; FileNotFoundError outside a clone."""
    root = _clone()
    if root is None:
        raise FileNotFoundError(
            f"expected a clone of polarnet, found no params.yaml beside a dvc.yaml in {Path.cwd()} or above; "
            f"run this command inside a clone"
        )
    changed = write_preset(root, options.name)
    print(f"params.yaml now holds {group_of(root, options.name)} {options.name}: {len(changed)} values changed")
    for line in changed:
        print(f"  {line}")
