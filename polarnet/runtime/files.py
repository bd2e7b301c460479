"""Checksums and locks, and files that are written whole or not at all."""

import hashlib
import shutil
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

SUMS = "SHA256SUMS"
"""File with the checksums of a folder, in the format of `sha256sum --check`."""
REMAKE = "run the stage that makes it again, or copy the folder again from where it is whole"


def sha256(*parts: bytes | memoryview | Path) -> str:
    """Hexadecimal SHA-256 of the parts one after another; a path stands for the content of its file."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            with part.open("rb") as file:
                hashlib.file_digest(file, lambda: digest)
        else:
            digest.update(part)
    return digest.hexdigest()


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """PATH.tmp for the new content of a file; it becomes `path` once the block ends.

    After an error, `path` is as it was and PATH.tmp is gone.
    """
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def check_room(folder: Path, needed: int, work: str) -> None:
    """OSError if the disk of a folder, which need not exist yet, has less than `needed` bytes free."""
    free = shutil.disk_usage(next(path for path in (folder, *folder.absolute().parents) if path.exists())).free
    if needed > free:
        raise OSError(
            f"{folder}: {work} need about {needed / 2**20:,.1f} MiB, the disk has {free / 2**20:,.1f} MiB free; make "
            "room or write to another disk, then run this again"
        )


def seal(folder: Path) -> None:
    """Write the checksum of every file below a finished folder into its `SUMS`."""
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    lines = [f"{sha256(folder / name)}  {name}\n" for name in files if name != SUMS]
    with replaced(folder / SUMS) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")


def changed_files(folder: Path, names: Collection[str] | None = None) -> list[str]:
    """A message for each file (of `names`; None: all) that is not as it was when `folder` was sealed.

    A folder without `SUMS` gives no message.
    """
    if not (folder / SUMS).is_file():
        return []
    problems = []
    for line in (folder / SUMS).read_text(encoding="utf-8", errors="replace").splitlines():
        digest, _, name = line.partition("  ")
        if names is None or name in names:
            path = folder / name
            if not name or not path.is_file():
                problems.append(f"{path} is missing, but {folder / SUMS} lists it; {REMAKE}")
            elif sha256(path) != digest:
                problems.append(f"{path} is not the file that {folder / SUMS} describes; {REMAKE}")
    return problems


def check_seal(folder: Path, names: Collection[str] | None = None) -> None:
    """ValueError for the first of `changed_files`."""
    for problem in changed_files(folder, names):
        raise ValueError(problem)


@contextmanager
def claimed(path: Path, say_waiting: Callable[[], None] | None = None) -> Iterator[None]:
    """Lock `path`, by PATH.lock.tmp, so that only this process may write it, until the block or the process ends.

    If another process has it: ValueError, or with `say_waiting` a call of it and a wait until the other one ends.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.with_name(f"{path.name}.lock.tmp")
    lock = FileLock(file, timeout=0, is_singleton=True)
    try:
        lock.acquire()
    except Timeout:
        if say_waiting is None:
            raise ValueError(
                f"{path}: another process is writing it; wait until that has ended, or write to another path"
            ) from None
        say_waiting()
        lock.acquire(timeout=-1)
    try:
        yield
    finally:
        file.unlink(missing_ok=True)
        lock.release()
