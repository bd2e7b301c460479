"""Output folders of commands: each holds one run."""

import contextlib
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from polarnet.runtime.files import claimed

MARKER = "run.json"
"""File that names the command whose run a folder holds."""
WORK = "work"
"""Folder beside the results from which a later run of a command may resume; never removed."""


@contextlib.contextmanager
def run_folder(folder: Path, command: str) -> Iterator[Path]:
    """FOLDER.partial, which takes the files of one run of `command`; they move to `folder` when the block ends.

    They replace the files of an earlier run of `command` there. After an error or an interruption, `folder` is
    unchanged. FOLDER.partial then remains only if it contains a file, and the next run replaces it. Raises ValueError
    if either folder contains other files, or while another run writes to `folder`.
    """
    partial = folder.resolve().with_name(f"{folder.resolve().name}.partial")
    for each in (folder, partial):
        _check_owner(each, command)
    absent = [each for each in (partial, *partial.parents) if not each.exists()]
    partial.mkdir(parents=True, exist_ok=True)
    with claimed(partial / MARKER):
        for earlier in _entries(partial):
            _remove(earlier)
        shutil.rmtree(partial / WORK, ignore_errors=True)
        (partial / MARKER).write_text(json.dumps({"command": f"polarnet {command}"}) + "\n", encoding="utf-8")
        try:
            yield partial
        except BaseException:
            _clean_up(partial, absent)
            raise
    folder.mkdir(exist_ok=True)
    for earlier in _entries(folder):
        _remove(earlier)
    for entry in partial.iterdir():
        if entry.name == WORK and (folder / WORK).exists():
            shutil.rmtree(folder / WORK)
        entry.rename(folder / entry.name)
    partial.rmdir()


def _entries(folder: Path) -> list[Path]:
    """Entries of a folder other than `WORK` and the lock of a run; none if the folder does not exist."""
    others = (WORK, f"{MARKER}.lock.tmp")
    return [path for path in folder.iterdir() if path.name not in others] if folder.is_dir() else []


def _check_owner(folder: Path, command: str) -> None:
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder, got a file; name a folder")
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


def _clean_up(partial: Path, absent: list[Path]) -> None:
    """Remove the files of a failed run that left no results; `absent` are the folders it created, innermost first."""
    results = (path for entry in _entries(partial) for path in (entry, *entry.rglob("*")))
    if any(path.is_file() and path.name != MARKER for path in results):
        print(f"files of the unfinished run: {partial}", file=sys.stderr)
        return
    shutil.rmtree(partial)
    for created in absent[1:]:
        with contextlib.suppress(OSError):  # another run has written into it
            created.rmdir()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
