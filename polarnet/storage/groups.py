"""Zarr groups of stores: columns as compressed arrays, and reading that raises where Zarr would fill gaps."""

import errno
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec
from zarr.storage import FsspecStore, LocalStore, WrapperStore, ZipStore

COMPRESSION_LEVEL = 1  # for zstd; higher levels cost 10-100 times the time for 6 % fewer bytes
SHORTAGES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EAGAIN)
REPAIR = "write this store again, or copy it again from where it is whole"


@dataclass(frozen=True)
class Column:
    """Layout of an array that every part has. A sequence has as many rows in each column of one `axis`."""

    axis: str
    dtype: str
    chunk: int
    """Rows that are compressed together, the smallest unit of reading."""
    shape: tuple[int, ...] = ()
    """Shape of a row."""


Columns = Mapping[str, Column]


class _WholeStore(WrapperStore[Any]):
    """A store that raises where a file of an array is missing or empty; Zarr itself would read fill values."""

    async def get(self, key: str, *arguments: Any, **options: Any) -> Any:
        content = await super().get(key, *arguments, **options)
        if "/c/" in key and not content:
            raise FileNotFoundError(f"there is no {key}, or nothing in it")
        return content


def is_url(path: str | os.PathLike[str]) -> bool:
    """Whether a path is an fsspec URL, such as s3://BUCKET/NAME.zarr."""
    return "://" in os.fspath(path)


def open_group(path: str | os.PathLike[str]) -> zarr.Group:
    """Open the Zarr group in a local folder, a zip or at an fsspec URL; FileNotFoundError if there is none."""
    name = os.fspath(path)
    store: FsspecStore | ZipStore | LocalStore
    try:
        if is_url(name):
            store = FsspecStore.from_url(name, read_only=True)
        elif Path(name).is_file():
            store = ZipStore(name, mode="r", read_only=True)
        else:
            store = LocalStore(name, read_only=True)
        return zarr.open_group(_WholeStore(store), mode="r", zarr_format=3)
    except FileNotFoundError:
        unfinished = f" ({name}.tmp is unfinished)" if Path(f"{name}.tmp").exists() else ""
        raise FileNotFoundError(
            f"{name}: there is no Zarr v3 group{unfinished}; run the stage that writes it"
        ) from None
    except ImportError:  # a package for reading URLs is missing
        raise
    except Exception as error:  # Zarr raises many kinds of exceptions for a damaged zarr.json
        raise_shortage(error, name)
        raise ValueError(f"{name} is unreadable: {error}; {REPAIR}") from error


class Shortage(RuntimeError):
    """The system gave no more memory, threads or file descriptors."""


def raise_shortage(error: Exception, path: str) -> None:
    """Raise `Shortage` if `error` comes from a lack of memory, threads or file descriptors; otherwise do nothing."""
    if isinstance(error, Shortage):
        raise error
    short = isinstance(error, MemoryError) or getattr(error, "errno", None) in SHORTAGES
    if short or "can't start new thread" in str(error):
        raise Shortage(
            f"{path} was not read, because the system gave no more memory, threads or file descriptors "
            f"({error or 'out of memory'}); lower runtime.workers, or raise the limits (ulimit -n, -u, -v)"
        ) from error


def create_array(group: zarr.Group, name: str, column: Column) -> zarr.Array:
    """An empty array of a group for a column, compressed, with a checksum of each chunk."""
    dtype = np.dtype(column.dtype)
    shuffle = BloscShuffle.bitshuffle if dtype.itemsize <= 2 else BloscShuffle.shuffle
    blosc = BloscCodec(typesize=dtype.itemsize, cname="zstd", clevel=COMPRESSION_LEVEL, shuffle=shuffle)
    return group.create_array(
        name,
        shape=(0, *column.shape),
        chunks=(column.chunk, *column.shape),
        dtype=dtype,
        fill_value=0,
        compressors=[blosc, Crc32cCodec()],
        config={"write_empty_chunks": True},  # a missing chunk is a damaged one
    )
