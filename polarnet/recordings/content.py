"""Content of a file in blocks of bytes or words, unpacked where it lies in a gzip or zip archive."""

import contextlib
import gzip
import itertools
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from polarnet.recordings.source import Counts, RecordingError
from polarnet.runtime.compilation import compiled

GZIP, ZIP = b"\x1f\x8b", b"PK\x03\x04"
WRAP_US = 2**32  # range of 32-bit time stamps
FOLLOWING = 8  # events that tell a wrap of the time stamps from one wrong stamp


@contextlib.contextmanager
def unpacked(path: Path) -> Iterator[Any]:
    """The binary content of a file, or of the one file in a gzip or zip archive; RecordingError for other archives."""
    with contextlib.ExitStack() as stack:
        file: Any = stack.enter_context(path.open("rb"))
        magic = file.read(len(ZIP))
        file.seek(0)
        try:
            if magic.startswith(GZIP):
                file = stack.enter_context(gzip.open(file))
            elif magic == ZIP:
                archive = zipfile.ZipFile(file)
                every = [one for one in archive.infolist() if not one.is_dir()]
                members = [one for one in every if not Path(one.filename).name.startswith(".")]  # as macOS adds
                if len(members) != 1:
                    raise RecordingError(
                        f"{path.name}: expected one recording in the zip archive, got {len(members)} files; unpack it"
                    )
                file = stack.enter_context(archive.open(members[0]))
            yield file
        except (EOFError, zlib.error, gzip.BadGzipFile, zipfile.BadZipFile, RuntimeError) as error:
            raise RecordingError(f"{path.name}: the archive cannot be unpacked: {error}") from error


def byte_blocks(path: Path, start: int, size: int, counts: Counts) -> Iterator[bytearray]:
    """The content from byte `start` on, unpacked, `size` bytes at a time; a cut archive is counted as `cut_tail`."""
    with unpacked(path) as file:
        block, on_disk = bytearray(), getattr(file, "fileobj", file)  # of gzip, the packed file
        try:
            file.seek(start)
            while data := file.read1(size - len(block)):
                block += data
                if len(block) == size:
                    counts.share_read = min(1.0, on_disk.tell() / path.stat().st_size)
                    yield block
                    block = bytearray()
        except EOFError:
            counts["cut_tail"] += 1
        if block:
            yield block


def start_of(path: Path, size: int) -> bytes:
    """The first bytes of a file, unpacked."""
    return bytes(next(byte_blocks(path, 0, size, Counts()), b""))


def word_blocks(path: Path, start: int, dtype: np.dtype | str, words: int, counts: Counts) -> Iterator[np.ndarray]:
    """The words of a file from byte `start` on, `words` at a time; a cut word at the end is counted as `cut_tail`."""
    size = np.dtype(dtype).itemsize
    for data in byte_blocks(path, start, words * size, counts):
        counts["cut_tail"] += len(data) % size != 0
        if len(data) >= size:
            yield np.frombuffer(data, dtype, len(data) // size)


def header_lines(path: Path, prefix: bytes, last: bytes, max_bytes: int) -> tuple[bytes, bytes, bool]:
    """First lines of a file that begin with `prefix`, the two bytes after them, and whether `last` ends them."""
    data = start_of(path, max_bytes)
    start, ended = 0, False
    while not ended and data.startswith(prefix, start) and (end := data.find(b"\n", start)) >= 0:
        ended = data[start:end].strip() == last
        start = end + 1
    return data[:start], data[start : start + 2], ended


def unwrapped(blocks: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Unwrapped times (int64) and entries of each block that is not empty; column `t` has 32-bit microseconds.

    A stamp on the other side of the range is a wrap if most of the events after it are there too. Otherwise it is one
    late or wrong stamp, and later times do not change.
    """
    state = None
    for block, following in itertools.pairwise(itertools.chain((one for one in blocks if len(one)), [None])):
        assert block is not None
        after = block["t"][:0] if following is None else following["t"][:FOLLOWING]
        t = np.concatenate([block["t"], after]).astype(np.int64)
        state = np.array([0, np.median(t[: FOLLOWING + 1])], np.int64) if state is None else state
        _unwrap(t, len(block), state)
        yield t[: len(block)], block


@compiled
def _unwrap(t, count, state):
    """Add the wraps to the first `count` times; `state` holds the wraps and the last credible stamp."""
    wraps, before = state
    for i in range(count):
        now = t[i]
        step = now - before
        wrap = 0
        if abs(step) > WRAP_US // 2:
            wrap = -1 if step > 0 else 1
            after = t[i + 1 : i + 1 + FOLLOWING]
            agree = np.sum(np.abs(after - before) > WRAP_US // 2)
            if 2 * agree < len(after):
                t[i] += (wraps + wrap) * WRAP_US
                continue
            wrap = max(wrap, 0)  # forwards, it is a pause
        wraps += wrap
        before = now
        t[i] += wraps * WRAP_US
    state[0], state[1] = wraps, before
