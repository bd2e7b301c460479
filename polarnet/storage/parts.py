"""The layout of every store, a folder of parts: how one is created, resumed, finished, read and verified.

    NAME.zarr/zarr.json                     header: format, version, names of the sequences, attributes
    NAME.zarr/part-00000/zarr.json          record of each sequence of the part: its rows in the columns, its numbers
    NAME.zarr/part-00000/events/t/...       one column: the rows of these sequences, one sequence after the other

The store and each of its parts are Zarr v3 groups, each column is a sharded array. Every sequence starts a chunk of its
own, so that reading one decodes nothing of its neighbours.

A store is written as NAME.zarr.tmp. One process writes a part, under a temporary name, and renames it when it is
complete; different processes write different parts. After a kill a part is whole or missing, and a rerun makes the
missing parts. `finish` marks the store complete and renames it. The same sequences give the same bytes, in any order of
the parts.
"""

import contextlib
import functools
import json
import os
import shutil
import uuid
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import fsspec
import numpy as np
import zarr
from pydantic import PositiveInt
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec
from zarr.storage import FsspecStore, LocalStore, WrapperStore, ZipStore

from polarnet.runtime.files import sha256
from polarnet.runtime.sections import section

COMPRESSION_LEVEL = 1  # for zstd; higher levels cost 10-100 times the time for 6 % fewer bytes
SHARD_BYTES = 2**25  # before compression; the writer of a part keeps about this much of each column in memory
MAX_CHUNKS_PER_SHARD = 256  # a shard ends with an index of 16 bytes for each of its chunks, used or not
REPAIR = "write this store again, or copy it again from where it is whole"

Header = dict[str, Any]


@section
class StorageConfig:
    """Section `storage` of params.yaml."""

    sequences_per_part: PositiveInt


@dataclass(frozen=True)
class Column:
    """One array of every part. A sequence has the same number of rows in all columns of an axis."""

    axis: str
    dtype: str
    chunk: int
    """Rows that are compressed together, the smallest unit of reading."""
    shape: tuple[int, ...] = ()
    """Shape of a row."""

    @property
    def shard(self) -> int:
        """Rows in a file, a multiple of `chunk`."""
        chunk_bytes = self.chunk * int(np.prod(self.shape)) * np.dtype(self.dtype).itemsize
        return self.chunk * min(max(1, SHARD_BYTES // chunk_bytes), MAX_CHUNKS_PER_SHARD)


Columns = Mapping[str, Column]
S = TypeVar("S", bound="Store")


class Store:
    """Named sequences in parts. A subclass declares format, version, columns, and the keys that it adds to the header.

    Every key of the header is an attribute of the store. A store can be sent to other processes.
    """

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int]
    sequences: list[str]
    sequences_per_part: int
    attributes: dict[str, Any]
    """Metadata given by the store's creator."""

    def __init__(self, path: str, header: Header):
        self.path = path
        self.header = header
        vars(self).update(header)
        starts = range(0, len(self.sequences), self.sequences_per_part)
        self.parts: dict[str, list[str]] = {
            f"part-{number:05d}": self.sequences[start : start + self.sequences_per_part]
            for number, start in enumerate(starts)
        }
        """Names of the sequences in each part."""
        self._part_of = {sequence: part for part, names in self.parts.items() for sequence in names}
        self._opened: dict[str, Any] = {}
        self._records: dict[str, Header] = {}
        self._unfinished: dict[str, _Part] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.header)

    @functools.cached_property
    def columns(self) -> Columns:
        """The arrays of each part."""
        raise NotImplementedError

    @classmethod
    def create_parts(
        cls: type[S],
        path: str | os.PathLike[str],
        sequences: Sequence[str],
        attributes: Mapping[str, Any],
        sequences_per_part: int,
        **metadata: Any,
    ) -> S:
        """Create a store to write at PATH.tmp, or resume the unfinished one there if its header is equal.

        One process creates the store and sends it to the others that write.
        """
        if not sequences:
            raise ValueError("expected at least one name, got none")
        if repeated := [name for name, times in Counter(sequences).items() if times > 1]:
            raise ValueError(f"expected each name once, got {', '.join(repeated[:8])} again")
        if sequences_per_part < 1:
            raise ValueError(f"expected at least one sequence per part, got {sequences_per_part}")
        header = {
            "format": cls.FORMAT,
            "version": cls.VERSION,
            "sequences": list(sequences),
            "sequences_per_part": sequences_per_part,
            **metadata,
            "attributes": dict(attributes),
        }
        try:
            header = json.loads(json.dumps(header, allow_nan=False))  # as read back from disk
        except (TypeError, ValueError) as error:
            raise ValueError(f"the attributes of a store must be finite, plain JSON: {error}") from None
        folder = Path(path).with_name(Path(path).name + ".tmp")
        if _unsigned(folder) != header:
            shutil.rmtree(folder, ignore_errors=True)
        zarr.open_group(folder, mode="a", zarr_format=3).attrs.put(_signed({**header, "complete": False}))
        return cls(str(folder), header)

    @classmethod
    def open(cls: type[S], path: str | os.PathLike[str]) -> S:
        """Open a finished store to read.

        `path` is a local folder, a zip of one (its zarr.json at the top, as `cd STORE; zip -r0 ../STORE.zip .` makes
        it), or an fsspec URL. FileNotFoundError where there is nothing; ValueError for other content, another version,
        or an unfinished store.
        """
        header = dict(open_group(path).attrs)
        if header.get("format") != cls.FORMAT:
            raise ValueError(f"{path}: expected a store of format {cls.FORMAT!r}, got {header.get('format')!r}")
        if header.get("version") != cls.VERSION:
            raise ValueError(
                f"{path}: expected version {cls.VERSION} of {cls.FORMAT}, got version {header.get('version')} of "
                "another polarnet; run `dvc repro`, which writes it again"
            )
        if header.get("complete") is not True:
            raise ValueError(f"{path}: the store was never finished; run the stage that writes it again")
        if not _is_signed(header):
            raise ValueError(f"{path}: the attributes in zarr.json are not what was written; {REPAIR}")
        return cls(os.fspath(path), header)

    def missing(self) -> list[str]:
        """Sequences of the parts that are not written yet, in the store's order."""
        return [sequence for part in self.missing_parts() for sequence in self.parts[part]]

    def missing_parts(self) -> list[str]:
        """Parts that are not written yet."""
        return [part for part in self.parts if not Path(self.path, part).exists()]

    def finish(self) -> None:
        """Mark the store complete and move it from PATH.tmp to PATH; ValueError where sequences are missing."""
        if missing := self.missing():
            raise ValueError(
                f"{self.path}: {len(missing)} not written yet: {', '.join(missing[:8])}; write them, then finish"
            )
        folder = Path(self.path)
        for leftover in [*folder.glob("*.tmp"), *folder.glob("*.partial")]:  # of processes killed while writing
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        zarr.open_group(folder, mode="r+").attrs.put(_signed({**self.header, "complete": True}))
        final = folder.with_name(folder.name.removesuffix(".tmp"))
        replaced = final.with_name(final.name + ".old")
        shutil.rmtree(replaced, ignore_errors=True)
        if final.exists():
            os.replace(final, replaced)  # a folder cannot be renamed onto one that is not empty
        os.replace(folder, final)
        shutil.rmtree(replaced, ignore_errors=True)

    def is_written(self, sequence: str) -> bool:
        """Whether the part of a sequence is complete."""
        return Path(self.path, self._part(sequence)).exists()

    def append(self, sequence: str, columns: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> None:
        """Add the next sequence to its part, with its rows in some columns and its numbers; the last one completes it.

        The sequences of a part come in the store's order, from one process. A part begins anew with its first sequence.
        ValueError for another order.
        """
        part, written = self._part(sequence), len(self.records_so_far(sequence))
        names = self.parts[part]
        if sequence != names[written]:
            raise ValueError(
                f"{self.path}: {part} takes its sequences in order, expected {names[written]}, got {sequence}"
            )
        if not written:
            self._unfinished[part] = _Part(Path(self.path, part), self.columns)
        self._unfinished[part].append(sequence, columns, record)
        if sequence == names[-1]:
            self._unfinished.pop(part).finish()

    def records_so_far(self, sequence: str) -> dict[str, Header]:
        """Records of the sequences before `sequence` in its part, while this process writes it."""
        part = self._part(sequence)
        if part not in self._unfinished or sequence == self.parts[part][0]:
            return {}
        return self._unfinished[part].records

    def record(self, sequence: str) -> Header:
        """Numbers of a stored sequence, and for each axis the start and stop of its rows."""
        part = self._part(sequence)
        if part not in self._records:
            try:
                header = dict(self._open(part).attrs)
                if not _is_signed(header) or list(header["sequences"]) != self.parts[part]:
                    raise ValueError("the attributes are not what was written")
            except Exception as error:  # Zarr raises many kinds of exceptions
                raise ValueError(
                    f"{self.path}: {sequence}, {part}/zarr.json is unreadable: {error}; {REPAIR}"
                ) from error
            self._records[part] = header["sequences"]
        return self._records[part][sequence]

    def read_column(self, name: str, sequence: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows `start` to `stop` (None: to the end) of a sequence; ValueError that names what cannot be read."""
        first, end = self.record(sequence)[self.columns[name].axis]
        rows = slice(first + start, end if stop is None else min(first + stop, end))
        try:
            values = np.asarray(self._open(f"{self._part(sequence)}/{name}")[rows])
            if len(values) != max(0, rows.stop - rows.start):
                raise ValueError(f"expected rows {rows.start} to {rows.stop}, got {len(values)} of them")
        except Exception as error:  # each codec raises its own exceptions
            raise ValueError(f"{self.path}: {sequence}, column {name} is unreadable: {error}; {REPAIR}") from error
        return values

    def read_columns(self, sequence: str, requests: Sequence[tuple[str, int, int | None]]) -> list[np.ndarray]:
        """`read_column` for several (name, start, stop), at the same time."""
        with ThreadPoolExecutor(len(requests)) as pool:
            return list(pool.map(lambda request: self.read_column(request[0], sequence, *request[1:]), requests))

    def problems(self, sequence: str) -> list[str]:
        """Messages about unreadable or missing data of a sequence."""
        try:
            self.record(sequence)
        except ValueError as error:
            return [str(error)]
        problems = []
        for name in self.columns:
            try:
                self.read_column(name, sequence)
            except ValueError as error:
                problems.append(str(error))
        return problems

    @classmethod
    def verify(cls, path: str | os.PathLike[str]) -> list[str]:
        """All problems of a store, each with its sequence and column; empty when every byte is as it was written."""
        try:
            store = cls.open(path)
        except (FileNotFoundError, ValueError) as error:
            return [str(error)]
        problems = [problem for sequence in store.sequences for problem in store.problems(sequence)]
        files = fsspec.get_mapper(f"zip::{path}" if Path(path).is_file() else os.fspath(path))
        for part, (first, *_) in store.parts.items():
            with contextlib.suppress(ValueError):  # the problem of every sequence of the part
                store.record(first)
                for name, digest in store._open(part).attrs["metadata_sha256"].items():
                    if sha256(files.get(f"{part}/{name}", b"")) != digest:
                        problems.append(f"{path}: {part}/{name} is not as it was written; {REPAIR}")
        return problems

    def _part(self, sequence: str) -> str:
        if sequence not in self._part_of:
            raise ValueError(f"{self.path}: there is no {sequence!r} among its {len(self.sequences)} sequences")
        return self._part_of[sequence]

    def _open(self, name: str) -> Any:
        """The part or the array of that name, kept open."""
        if name not in self._opened:
            self._opened[name] = self._open("")[name] if name else open_group(self.path)
        return self._opened[name]


class _Part:
    """A part that one process writes, under a temporary name until it is complete."""

    def __init__(self, path: Path, columns: Columns):
        self.path = path
        self.records: dict[str, Header] = {}
        self._temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex}.tmp")
        self._group = zarr.open_group(self._temporary, mode="w", zarr_format=3)
        self._columns = columns
        self._arrays = {name: _create_array(self._group, name, column) for name, column in columns.items()}
        self._pending = {name: np.empty((0, *column.shape), column.dtype) for name, column in columns.items()}

    def append(self, sequence: str, columns: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> None:
        """Take the rows and the record of a sequence; whole shards go to disk."""
        rows = {}
        for name, values in columns.items():
            column, array, pending = self._columns[name], self._arrays[name], self._pending[name]
            start = array.shape[0] + len(pending)
            rows[column.axis] = [start, start + len(values)]
            padding = np.zeros((-len(values) % column.chunk, *column.shape), column.dtype)
            pending = np.concatenate([pending, values, padding])
            whole = len(pending) - len(pending) % column.shard
            if whole:
                array.append(pending[:whole])
            self._pending[name] = pending[whole:]
        self.records[sequence] = {**record, **rows}

    def finish(self) -> None:
        """Write the attributes last, then give the part its name, unless another process did so first."""
        for name, pending in self._pending.items():
            if len(pending):
                self._arrays[name].append(pending)
        files = sorted(self._temporary.glob("*/**/zarr.json"))
        digests = {file.relative_to(self._temporary).as_posix(): sha256(file) for file in files}
        self._group.attrs.put(_signed({"sequences": self.records, "metadata_sha256": digests}))
        try:
            os.rename(self._temporary, self.path)
        except OSError:
            if not self.path.exists():
                raise
            shutil.rmtree(self._temporary)


class _WholeStore(WrapperStore[Any]):
    """A store that raises where a file of an array is missing or empty; Zarr itself would read fill values."""

    async def get(self, key: str, *arguments: Any, **options: Any) -> Any:
        content = await super().get(key, *arguments, **options)
        if "/c/" in key and not content:
            raise FileNotFoundError(f"there is no {key}, or nothing in it")
        return content


def open_group(path: str | os.PathLike[str]) -> zarr.Group:
    """Open the Zarr group in a local folder, a zip or at an fsspec URL; FileNotFoundError if there is none."""
    name = os.fspath(path)
    store: FsspecStore | ZipStore | LocalStore
    try:
        if "://" in name:
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
        raise ValueError(f"{name} is unreadable: {error}; {REPAIR}") from error


def _create_array(group: zarr.Group, name: str, column: Column) -> zarr.Array:
    dtype = np.dtype(column.dtype)
    shuffle = BloscShuffle.bitshuffle if dtype.itemsize <= 2 else BloscShuffle.shuffle
    blosc = BloscCodec(typesize=dtype.itemsize, cname="zstd", clevel=COMPRESSION_LEVEL, shuffle=shuffle)
    return group.create_array(
        name,
        shape=(0, *column.shape),
        chunks=(column.chunk, *column.shape),
        shards=(column.shard, *column.shape),
        dtype=dtype,
        fill_value=0,
        compressors=[blosc, Crc32cCodec()],
        config={"write_empty_chunks": True},  # a missing chunk is a damaged one
    )


def _signed(header: Header) -> Header:
    """The header with a checksum of the rest."""
    return {**header, "checksum": sha256(json.dumps(header, sort_keys=True).encode())}


def _is_signed(header: Header) -> bool:
    return _signed({key: value for key, value in header.items() if key != "checksum"}) == header


def _unsigned(folder: Path) -> Header | None:
    """The header that `create_parts` gave to a store; None if there is no store."""
    try:
        header = json.loads((folder / "zarr.json").read_text())["attributes"]
        return {key: value for key, value in header.items() if key not in ("complete", "checksum")}
    except (OSError, ValueError, KeyError):
        return None
