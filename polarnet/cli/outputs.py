"""Output folders of commands: each holds one run."""

import contextlib
import json
import os
import shutil
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from polarnet.runtime.files import claimed, publish

MARKER = "run.json"
"""File that names the command whose run a folder holds."""
WORK = "work"
"""Folder beside the results from which a later run of a command may resume; never removed."""


@contextlib.contextmanager
def run_folder(folder: Path, command: str) -> Iterator[Path]:
    """FOLDER.partial, which takes the files of one run of `command`; it becomes `folder` when the block ends.

    It replaces an earlier run of `command` there, at once. After an error or an interruption, `folder` is unchanged.
    FOLDER.partial then remains only if it contains a file, and the next run replaces it. Raises ValueError if either
    folder contains other files, or while another run writes to `folder`.
    """
    place = folder.resolve()
    if Path.cwd().is_relative_to(place):
        raise ValueError(f"{folder}: expected a folder of its own, got the one you are in; name one below it")
    partial = place.with_name(f"{place.name}.partial")
    absent = [each for each in (partial, *partial.parents) if not each.exists()]
    with contextlib.ExitStack() as at_end:
        at_end.callback(_remove_empty, absent[1:])
        at_end.enter_context(claimed(place))
        for each in (place, partial):
            _check_owner(each, command)
        if (partial / WORK).exists() and place.exists() and not (place / WORK).exists():
            (partial / WORK).rename(place / WORK)  # of a run that ended while it published
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        try:
            (partial / MARKER).write_text(json.dumps({"command": f"polarnet {command}"}) + "\n", encoding="utf-8")
            yield partial
        except BaseException:
            _remove_without_results(partial)
            raise
        if (place / WORK).exists() and not (partial / WORK).exists():
            (place / WORK).rename(partial / WORK)
        publish(partial, place)


def _entries(folder: Path) -> list[Path]:
    """Entries of a folder other than `WORK` and the marker; none if the folder does not exist."""
    return [path for path in folder.iterdir() if path.name not in (WORK, MARKER)] if folder.is_dir() else []


def _check_owner(folder: Path, command: str) -> None:
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder, got a file; name a folder")
    if folder.exists() and not os.access(folder, os.W_OK):  # could be renamed, but not removed
        raise ValueError(f"{folder}: expected a folder that you may write, it belongs to another user; name another")
    if not _entries(folder):
        return
    try:
        owner = json.loads((folder / MARKER).read_text(encoding="utf-8"))["command"]
    except (OSError, ValueError, KeyError, TypeError):
        owner = None
    if owner != f"polarnet {command}":
        raise ValueError(
            f"{folder} contains files that `polarnet {command}` did not write; name another folder, or empty this one"
        )


def _remove_without_results(partial: Path) -> None:
    """Remove the folder of a failed run unless it has results, which it then names."""
    if any(path.is_file() for entry in _entries(partial) for path in (entry, *entry.rglob("*"))):
        print(f"files of the unfinished run: {partial}", file=sys.stderr)
    else:
        shutil.rmtree(partial, ignore_errors=True)


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove those of the folders that are empty, innermost first."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()
