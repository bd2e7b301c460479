"""The hash of contents, files that are written whole or not at all, and the settings that came with the package."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

PACKAGE = Path(__file__).parents[1]
INSTALLED = PACKAGE / "config" / "settings"


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


def shipped_settings() -> Path:
    """Folder of params.yaml and conf/ beside the code: the copy that setup.py puts into a wheel, or the source tree."""
    return PACKAGE.parent if in_source_tree() else INSTALLED


def in_source_tree() -> bool:
    """Whether the code lies in a clone, and not in a wheel, which has a copy of the settings."""
    return not INSTALLED.is_dir()


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


@contextmanager
def claimed(path: Path) -> Iterator[None]:
    """The right of this process alone to write `path`, held in PATH.lock.tmp; it ends with the process at the latest.

    ValueError if another process has it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.with_name(f"{path.name}.lock.tmp")
    lock = FileLock(file, timeout=0, is_singleton=True)
    try:
        lock.acquire()
    except Timeout:
        raise ValueError(
            f"{path}: another process is writing it; wait until that has ended, or write to another path"
        ) from None
    try:
        yield
    finally:
        file.unlink(missing_ok=True)
        lock.release()
