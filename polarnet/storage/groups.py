"""Zarr groups of columns: written block by block in bounded memory, and read so that missing data is an error."""

import errno
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np
import zarr
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec
from zarr.storage import FsspecStore, LocalStore, WrapperStore

COMPRESSION_LEVEL = 1  # for zstd; higher levels cost 10-100 times the time for 6 % fewer bytes
SHARD_BYTES = 2**26  # rows of all columns that wait for a full shard, before compression
SHORTAGES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EAGAIN)
NO_THREAD = "can't start new thread"
REPAIR = "write this store again, or copy it again from where it is whole"


class _WholeStore(WrapperStore[Any]):
    """A store that raises where a file of an array is missing or empty; Zarr itself would read fill values."""

    async def get(self, key: str, *arguments: Any, **options: Any) -> Any:
        content = await super().get(key, *arguments, **options)
        if "c/" in key and not content:
            raise FileNotFoundError(f"there is no {key}, or nothing in it")
        return content


def is_url(path: str | os.PathLike[str]) -> bool:
    """Whether a path is an fsspec URL, such as s3://BUCKET/NAME.zarr."""
    return "://" in os.fspath(path)


def open_group(path: str | os.PathLike[str]) -> zarr.Group:
    """Open the Zarr group in a local folder or at an fsspec URL; FileNotFoundError if there is none."""
    name = os.fspath(path)
    metadata = Path(name, "zarr.json")
    if not is_url(path) and metadata.exists() and not metadata.is_file():
        raise ValueError(f"{metadata}: expected a file, got another thing; {REPAIR}")
    try:
        store = FsspecStore.from_url(name, read_only=True) if is_url(name) else LocalStore(name, read_only=True)
        return zarr.open_group(_WholeStore(store), mode="r", zarr_format=3)
    except FileNotFoundError:
        unfinished = f" ({name}.tmp is unfinished)" if Path(f"{name}.tmp").exists() else ""
        raise FileNotFoundError(
            f"{name}: there is no Zarr v3 group{unfinished}; run the stage that writes it"
        ) from None
    except ImportError:  # a package for reading URLs is missing
        raise
    except Exception as error:  # Zarr raises many kinds of exceptions for a damaged zarr.json
        raise_unreadable(error, name)


def raise_unreadable(error: Exception, data: str) -> NoReturn:
    """ValueError about damaged `data`; `error` itself if the system has no more memory, threads or open files."""
    if isinstance(error, MemoryError) or getattr(error, "errno", None) in SHORTAGES or NO_THREAD in str(error):
        raise error
    raise ValueError(f"{data} is unreadable: {error}; {REPAIR}") from error


class GrowingColumns:
    """Arrays of a Zarr group, of one length, that grow by rows; the first rows decide their names, types and shapes.

    Rows wait in memory until they fill a block, which is then written: `SHARD_BYTES` of chunks if `sharded`, so that
    each column is one file unless it is large; otherwise one chunk, for readers that follow a running program. The
    group appears with the first block.
    """

    def __init__(self, path: Path, chunk: int, sharded: bool, conventions: Mapping[str, str] = MappingProxyType({})):
        """`chunk` is the number of rows that are compressed together; `conventions` explain the columns to readers."""
        self.path = path
        self.chunk, self._sharded, self._conventions = chunk, sharded, conventions
        self._group: zarr.Group | None = None
        self._arrays: dict[str, zarr.Array] = {}
        self._waiting: dict[str, list[np.ndarray]] = {}
        self._rows = 0  # that wait

    def append(self, rows: Mapping[str, np.ndarray]) -> None:
        """Add rows to every column."""
        for name, values in rows.items():
            self._waiting.setdefault(name, []).append(values)
        self._rows += len(next(iter(rows.values())))
        row_bytes = sum(values.itemsize * int(np.prod(values.shape[1:])) for values in rows.values())
        block = self.chunk * (max(1, SHARD_BYTES // (row_bytes * self.chunk)) if self._sharded else 1)
        while self._rows >= block:
            self._write(block)

    def add(self, row: Mapping[str, np.ndarray]) -> None:
        """Add one row to every column."""
        self.append({name: values[None] for name, values in row.items()})

    def flush(self) -> None:
        """Write the rows that are still in memory."""
        if self._rows or (self._waiting and self._group is None):
            self._write(self._rows)

    def _write(self, rows: int) -> None:
        """Write the first `rows` waiting rows; the first call also makes the group and its arrays."""
        if self._group is None:
            conventions = {name: self._conventions[name] for name in self._waiting if name in self._conventions}
            self._group = zarr.create_group(self.path, overwrite=True, attributes={"conventions": conventions})
        for name, pieces in self._waiting.items():
            values = np.concatenate(pieces) if len(pieces) > 1 else pieces[0]
            if name not in self._arrays:
                self._arrays[name] = self._array(self._group, name, values, rows)
            self._arrays[name].append(values[:rows])
            rest = values[rows:]
            self._waiting[name] = [rest if len(rest) > rows else rest.copy()]  # a view would hold all of `values`
        self._rows -= rows

    def _array(self, group: zarr.Group, name: str, values: np.ndarray, rows: int) -> zarr.Array:
        shape = values.shape[1:]
        shuffle = BloscShuffle.bitshuffle if values.itemsize <= 2 else BloscShuffle.shuffle
        zstd = BloscCodec(typesize=values.itemsize, cname="zstd", clevel=COMPRESSION_LEVEL, shuffle=shuffle)
        lz4 = BloscCodec(typesize=values.itemsize, cname="lz4", shuffle=BloscShuffle.shuffle)  # keeps up with a camera
        return group.create_array(
            name,
            shape=(0, *shape),
            chunks=(self.chunk, *shape),
            shards=(-(-max(rows, 1) // self.chunk) * self.chunk, *shape) if self._sharded else None,
            dtype=values.dtype,
            fill_value=0,
            compressors=[zstd if self._sharded else lz4, Crc32cCodec()],
            config={"write_empty_chunks": True},  # a missing chunk is a damaged one
        )
