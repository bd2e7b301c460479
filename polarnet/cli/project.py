"""Commands for a project of polarnet: its settings, and what is installed."""

import argparse
from pathlib import Path

from polarnet.cli.parsers import Commands
from polarnet.terminal.installation import shipped_settings


def add_to(commands: Commands) -> None:
    """Add the commands doctor and preset."""
    doctor = commands.add_parser(
        "doctor",
        help="report versions, device, weights, extras, memory and disk",
        epilog="example: polarnet doctor --weights best.safetensors",
    )
    doctor.add_argument(
        "--weights", type=Path, metavar="FILE", help="check a file of weights, and name the rows that can use it"
    )
    doctor.set_defaults(run=_doctor)

    preset = commands.add_parser(
        "preset",
        help="write a named experiment or sensor into params.yaml, keeping comments",
        epilog="example: polarnet preset smoke",
    )
    preset.add_argument("name", help="name of a file in conf/experiment or conf/sensor: demo, smoke, paper, noisy, ...")
    preset.set_defaults(run=_preset)


def project_root() -> Path:
    """The nearest folder at or above the current one with params.yaml and dvc.yaml; FileNotFoundError if none has."""
    if clone := _clone():
        return clone
    raise FileNotFoundError(
        f"expected a clone of polarnet, found no params.yaml beside a dvc.yaml in {Path.cwd()} or above; "
        f"run this command inside a clone"
    )


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


def _doctor(options: argparse.Namespace) -> int:
    from polarnet.cli.doctor import findings, rows_for

    if options.weights is not None and not options.weights.is_file():
        raise FileNotFoundError(f"--weights {options.weights}: there is no such file")
    for finding in rows_for(options.weights) if options.weights else findings():
        print(finding)
    return 0


def _preset(options: argparse.Namespace) -> int:
    from polarnet.config.experiments import group_of, write_preset

    root = project_root()
    changed = write_preset(root, options.name)
    print(f"params.yaml now holds {group_of(root, options.name)} {options.name}: {len(changed)} values changed")
    for line in changed:
        print(f"  {line}")
    return 0
