"""Output folders of commands: each holds one run."""

import contextlib
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

MARKER = "run.json"
"""File that names the command whose run a folder holds."""
WORK = "work"
"""Folder beside the results that a later run of a command may go on from; never removed."""


@contextlib.contextmanager
def run_folder(folder: Path, command: str) -> Iterator[Path]:
    """FOLDER.partial, for the files of one run of `command`; they move to `folder` once the block ends.

    They replace those of an earlier run of `command` there. After an error or an interruption, `folder` is as it was,
    and FOLDER.partial stays only where it holds a file: the next run replaces it. ValueError where either folder holds
    files of anything else.
    """
    partial = folder.resolve().with_name(f"{folder.resolve().name}.partial")
    for each in (folder, partial):
        _check_held(each, command)
    if partial.exists():
        shutil.rmtree(partial)
    absent = [each for each in (partial, *partial.parents) if not each.exists()]
    partial.mkdir(parents=True)
    (partial / MARKER).write_text(json.dumps({"command": f"polarnet {command}"}) + "\n", encoding="utf-8")
    try:
        yield partial
    except BaseException:
        _give_up(partial, absent)
        raise
    folder.mkdir(exist_ok=True)
    for earlier in _entries(folder):
        _remove(earlier)
    for made in partial.iterdir():
        if made.name == WORK and (folder / WORK).exists():
            shutil.rmtree(folder / WORK)
        made.rename(folder / made.name)
    partial.rmdir()


def _entries(folder: Path) -> list[Path]:
    """What a folder holds beside `WORK`; nothing where it does not exist."""
    return [path for path in folder.iterdir() if path.name != WORK] if folder.is_dir() else []


def _check_held(folder: Path, command: str) -> None:
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file; name a folder")
    if not _entries(folder):
        return
    try:
        held = json.loads((folder / MARKER).read_text(encoding="utf-8"))["command"]
    except (OSError, ValueError, KeyError, TypeError):
        held = None
    if held != f"polarnet {command}":
        raise ValueError(
            f"{folder} holds files that `polarnet {command}` did not write; name another folder, or empty this one"
        )


def _give_up(partial: Path, absent: list[Path]) -> None:
    """Remove what a failed run left, unless it holds results; `absent` are the folders it made, innermost first."""
    results = (path for entry in _entries(partial) for path in (entry, *entry.rglob("*")))
    if any(path.is_file() and path.name != MARKER for path in results):
        print(f"files made until then: {partial}", file=sys.stderr)
        return
    shutil.rmtree(partial)
    for made in absent[1:]:
        with contextlib.suppress(OSError):  # another run has put something there
            made.rmdir()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
