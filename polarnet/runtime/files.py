"""Checksums and locks, and files and folders that are published whole or not at all.

One way to publish: write beside the place, seal, bring every byte to the disk, and rename once.
"""

import contextlib
import ctypes
import errno
import functools
import hashlib
import os
import shutil
import unicodedata
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

SUMS = "SHA256SUMS"
"""File with the checksums of a folder, in the format of `sha256sum --check`."""
ORIGIN = "origin.json"
"""File in a folder of the pipeline that says how it was made (`polarnet.config.origins`); it has its own checksum."""
REMAKE = "run the stage that makes it again, or copy the folder again from where it is whole"
UNSEEN = ("Cc", "Cf", "Cs", "Zl", "Zp")  # categories of Unicode: control, format, surrogate, line, paragraph
MAX_NAME = 200  # bytes; file systems allow 255, and names get suffixes
EXCHANGE = 2  # RENAME_EXCHANGE of Linux
AT_FDCWD = -100
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # disk, quota, limit of a file's size


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


@functools.cache
def code_digest() -> str:
    """SHA-256 of all modules of polarnet: what another version of the code has begun is not continued."""
    package = Path(__file__).parent.parent
    modules = sorted(package.rglob("*.py"))
    return sha256(*(part for file in modules for part in (str(file.relative_to(package)).encode(), file)))


def check_name(name: str) -> str:
    """The name itself, of a sequence or another thing that a path is made of; ValueError if it could name a place.

    ValueError, too, for letters that no one sees, that turn a line around, or that no file's name can hold.
    """
    strange = any(letter in "/\\" or unicodedata.category(letter) in UNSEEN for letter in name)
    if strange or name in ("", ".", "..") or len(name.encode(errors="replace")) > MAX_NAME:
        raise ValueError(
            f"expected a name without slashes and control characters, of at most {MAX_NAME} bytes, got {name[:80]!a}"
        )
    return name


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """PATH.tmp for the new content of a file, which only this process may write; it becomes `path` at the block's end.

    After an error, `path` is as it was and PATH.tmp is gone. ValueError while another process writes the file, and for
    a folder or a device such as /dev/null.
    """
    if path.exists() and not path.is_file():
        raise ValueError(f"{path}: expected the name of a file, got a folder or a device; name another")
    temporary = path.with_name(f"{path.name}.tmp")
    with claimed(path):
        temporary.unlink(missing_ok=True)  # it could be a link to a file elsewhere
        try:
            yield temporary
            _to_disk(temporary)
            temporary.replace(path)
            _to_disk(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


def publish(finished: Path, place: Path) -> None:
    """Move a finished folder to its place, where it replaces what was there.

    At every moment, after a kill or a power cut too, `place` is the old folder or the new one. Where the system cannot
    exchange two folders at once, a kill between two renames leaves the old one as PLACE.old.tmp, which `claimed`
    restores.
    """
    to_disk(finished)
    old = _old(place)
    shutil.rmtree(old, ignore_errors=True)  # of a process that was killed while it removed it
    if not place.exists():
        os.rename(finished, place)
    elif _exchanged(finished, place):
        os.rename(finished, old)
    else:
        os.rename(place, old)
        os.rename(finished, place)
    _to_disk(place.parent)
    shutil.rmtree(old, ignore_errors=True)


def to_disk(folder: Path) -> None:
    """Bring a folder and everything in it to the disk."""
    for path in (*folder.rglob("*"), folder):
        if not path.is_symlink():
            _to_disk(path)


def _old(place: Path) -> Path:
    return place.with_name(f"{place.name}.old.tmp")


def _exchanged(one: Path, other: Path) -> bool:
    """Whether two folders took each other's place, in one step."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    return rename is not None and not rename(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), EXCHANGE)


def _to_disk(path: Path) -> None:
    """Bring a file, or the names in a folder, to the disk; a folder on a system that cannot do so stays as it is."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(handle)


@contextmanager
def named_shortage(path: Path) -> Iterator[None]:
    """OSError that names `path` if the block ends because a disk is full, or a quota or a limit is reached."""
    try:
        yield
    except (OSError, RuntimeError) as error:  # RuntimeError: h5py
        for shortage in map(os.strerror, FULL):
            if shortage in str(error):
                raise OSError(
                    f"{path}: {shortage}; make room, or write to another disk, then run this again"
                ) from error
        raise


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
    with replaced(folder / SUMS) as temporary:
        lines = [f"{sha256(folder / name)}  {name}\n" for name in _sealed(folder)]
        temporary.write_text("".join(lines), encoding="utf-8")


def files_of(place: Path) -> list[Path]:
    """Files of an artefact, a file or a folder, by name: all but its origin, hidden and temporary ones."""
    files = sorted(path for path in (place, *place.rglob("*")) if path.is_file())
    return [file for file in files if not (file.name == ORIGIN or file.suffix == ".tmp" or file.name.startswith("."))]


def _sealed(folder: Path) -> list[str]:
    """Names of the files that the seal of a folder lists, which are all but the seal itself."""
    names = [file.relative_to(folder).as_posix() for file in files_of(folder)]
    return [name for name in names if name != SUMS]


def changed_files(folder: Path, names: Collection[str] | None = None) -> list[str]:
    """A message for each file (of `names`; None: all) that is not as it was when `folder` was sealed.

    A missing seal and a file that the seal does not list are changes, too.
    """
    seal_file = folder / SUMS
    if not seal_file.is_file():
        return [f"{seal_file} is missing, so that nothing says whether {folder} is whole; {REMAKE}"]
    lines = [line.partition("  ") for line in seal_file.read_text(encoding="utf-8", errors="replace").splitlines()]
    listed = {name: digest for digest, _, name in lines}
    problems = []
    for name in sorted({*listed, *_sealed(folder)} if names is None else names):
        path = folder / name
        if name not in listed:
            problems.append(f"{path} is not in {seal_file}; {REMAKE}")
        elif not name or not path.is_file():
            problems.append(f"{path} is missing, but {seal_file} lists it; {REMAKE}")
        elif sha256(path) != listed[name]:
            problems.append(f"{path} is not the file that {seal_file} describes; {REMAKE}")
    return problems


def check_seal(folder: Path, names: Collection[str] | None = None) -> None:
    """ValueError for the first of `changed_files`."""
    for problem in changed_files(folder, names):
        raise ValueError(problem)


@contextmanager
def claimed(path: Path) -> Iterator[None]:
    """Lock `path`, by PATH.lock.tmp, so that only this process may write it, until the block or the process ends.

    ValueError if another process has it; OSError with the name of `path` where a disk is full.
    """
    file = path.with_name(f"{path.name}.lock.tmp")
    lock = FileLock(file, timeout=0, is_singleton=True)
    try:
        with named_shortage(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            lock.acquire()
    except Timeout:
        raise ValueError(
            f"{path}: another process is writing it; wait until that has ended, or write to another path"
        ) from None
    try:
        if not path.exists():
            with contextlib.suppress(FileNotFoundError):
                _old(path).rename(path)
        with named_shortage(path):
            yield
    finally:
        file.unlink(missing_ok=True)
        lock.release()
