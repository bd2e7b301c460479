"""The project around the current folder, and the commands that write one or its settings: new, preset."""

import argparse
import shlex
import shutil
from pathlib import Path

from ruamel.yaml import YAML

from polarnet import __version__
from polarnet.config.experiments import group_of, write_preset
from polarnet.runtime.files import named_shortage
from polarnet.terminal.installation import LPIPS, LPIPS_COMMAND, missing, shipped_settings, version_of

COPIED = ("params.yaml", "conf/**/*.yaml", "stages/*.py", "data/**/README.md")
CODE = "polarnet/"
"""Dependencies in dvc.yaml on the code of polarnet, which a project replaces by `VERSION`."""
VERSION = "version.txt"
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


def _clone() -> Path | None:
    """The nearest folder at or above the current one with params.yaml and dvc.yaml."""
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
    """Write a preset into params.yaml."""
    if (root := _clone()) is None:
        raise FileNotFoundError(
            f"expected a clone of polarnet, found no params.yaml beside a dvc.yaml in {Path.cwd()} or above; "
            f"run this command inside a clone"
        )
    changed = write_preset(root, options.name)
    print(f"params.yaml now holds {group_of(root, options.name)} {options.name}: {len(changed)} values changed")
    for line in changed:
        print(f"  {line}")


def new(options: argparse.Namespace) -> None:
    """Write a project into a new or empty folder; ValueError for another one."""
    folder: Path = options.folder
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder}: expected a new or an empty folder, got one with files; name another")
    try:
        with named_shortage(folder):
            _fill(folder)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    commands = [["cd", str(folder)], ["dvc", "repro"]]
    if packages := missing("pipeline"):
        commands.insert(0, ["pip", "install", *packages])
    if version_of(LPIPS) is None:
        commands.insert(0, shlex.split(LPIPS_COMMAND))
    print(f"{folder / 'params.yaml'} has the values; these commands run the pipeline:")
    print(*map(shlex.join, commands), sep="\n")


def _fill(folder: Path) -> None:
    """Write the files of a project."""
    source = shipped_settings()
    for path in (path for pattern in COPIED for path in sorted(source.glob(pattern))):
        target = folder / path.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    _write_pipeline(source / "dvc.yaml", folder / "dvc.yaml")
    (folder / ".dvc").mkdir()
    for name, text in ((VERSION, f"polarnet {__version__}\n"), (".gitignore", IGNORED), (".dvc/config", DVC)):
        (folder / name).write_text(text, encoding="utf-8")


def _write_pipeline(source: Path, target: Path) -> None:
    """Copy dvc.yaml with dependencies on polarnet's version in place of its files."""
    yaml = YAML()
    yaml.width = 120
    pipeline = yaml.load(source)
    del pipeline["artifacts"]
    for stage in pipeline["stages"].values():
        content = stage.get("do", stage)
        content["deps"] = [VERSION, *(one for one in content["deps"] if not one.startswith(CODE))]
    yaml.dump(pipeline, target)
