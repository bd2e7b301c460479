"""Command that writes a project: the pipeline with its settings, for an installed polarnet."""

import argparse
from pathlib import Path

from polarnet import __version__
from polarnet.cli.parsers import Commands

COPIED = ("params.yaml", "conf/**/*.yaml", "stages/*.py", "data/**/README.md")
CODE = "polarnet/"
"""Dependencies in dvc.yaml on the code of polarnet, which a project replaces by `REQUIREMENTS`."""
REQUIREMENTS = "requirements.txt"
IGNORED = """/data/*
!/data/*/
/data/*/*
!/data/external/*/
/data/external/*/*
!/data/**/README.md
/outputs/
__pycache__/
"""
DVC = "[core]\n    analytics = false\n    no_scm = true\n"  # `dvc init --force` in a Git repository replaces it


def add_to(commands: Commands) -> None:
    """Add the command new."""
    new = commands.add_parser(
        "new",
        help="write a project with the pipeline: dvc.yaml, params.yaml, conf, stages",
        description="Writes a folder in which `dvc repro` runs the pipeline with the installed polarnet. The stages "
        "run again after a change of requirements.txt, which names polarnet's version.",
        epilog="example:\n  polarnet new lake && cd lake && polarnet preset smoke && dvc repro",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    new.add_argument("folder", type=Path, metavar="FOLDER", help="folder to write; it must be new or empty")
    new.set_defaults(run=_new)


def _new(options: argparse.Namespace) -> int:
    write_project(options.folder)
    print(f"{options.folder}: run the pipeline with `cd {options.folder} && dvc repro`; values are in params.yaml")
    return 0


def write_project(folder: Path) -> None:
    """Write a project into a new or empty folder; ValueError for another one."""
    import shutil

    from polarnet.terminal.installation import shipped_settings

    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder}: expected a new or an empty folder, got one with files; name another")
    source = shipped_settings()
    for path in (path for pattern in COPIED for path in sorted(source.glob(pattern))):
        target = folder / path.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    _write_pipeline(source / "dvc.yaml", folder / "dvc.yaml")
    (folder / ".dvc").mkdir()
    for name, text in ((REQUIREMENTS, f"polarnet=={__version__}\n"), (".gitignore", IGNORED), (".dvc/config", DVC)):
        (folder / name).write_text(text, encoding="utf-8")


def _write_pipeline(source: Path, target: Path) -> None:
    """Copy dvc.yaml with dependencies on polarnet's version in place of its files."""
    from ruamel.yaml import YAML

    yaml = YAML()
    yaml.width = 120
    pipeline = yaml.load(source)
    del pipeline["artifacts"]
    for stage in pipeline["stages"].values():
        content = stage.get("do", stage)
        content["deps"] = [REQUIREMENTS, *(one for one in content["deps"] if not one.startswith(CODE))]
    yaml.dump(pipeline, target)
