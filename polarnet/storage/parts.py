"""The layout of every store, a folder of parts: how one is created, resumed, finished, read and verified.

    NAME.zarr/zarr.json                header: format, version, names of the sequences, attributes, digest of each part
    NAME.zarr/part-00000/zarr.json     record of each sequence of the part: its rows in the columns, its own metadata;
                                       SHA-256 of each other file of the part
    NAME.zarr/part-00000/t/zarr.json   one column: the rows of these sequences, one sequence after the other
    NAME.zarr/part-00000/t/c/0         its shard; a column of many megabytes has several

The store and each of its parts are Zarr v3 groups, each column is a sharded array. The digest of a part is the SHA-256
of its zarr.json, which vouches for the part's other files. Every sequence starts a chunk of its own, so that reading
one decodes nothing of its neighbours; the rows between two sequences are 0.

A store is written as NAME.zarr.tmp. One process writes a part, under a temporary name, and renames it when it is
complete; different processes write different parts. After a kill a part is whole or missing, and a rerun makes the
missing parts, if its header and its code (`code_digest`) are those that began the store. `finish` writes the digests
into the header, which marks the store complete, and publishes it. At an fsspec URL nothing is renamed: a part is whole
once it has its zarr.json, which is copied last. The same sequences give the same bytes, in any order of the parts.
"""

import contextlib
import functools
import hashlib
import json
import os
import shutil
import tempfile
import uuid
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import fsspec
import numpy as np
import zarr
from pydantic import PositiveInt

from polarnet.runtime.files import check_name, check_room, claimed, code_digest, publish, sha256
from polarnet.runtime.sections import section
from polarnet.storage.groups import REPAIR, GrowingColumns, is_url, open_group, raise_unreadable

METADATA = "zarr.json"
MAX_LISTED = 8  # names of sequences in a message

Header = dict[str, Any]
S = TypeVar("S", bound="Store")


@section
class StorageConfig:
    """Section `storage` of params.yaml."""

    sequences_per_part: PositiveInt


class Store:
    """Named sequences in parts. A subclass declares format, version, columns, and the keys that it adds to the header.

    Every key of the header is an attribute of the store. A store can be sent to other processes.
    """

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int]
    sequences: list[str]
    sequences_per_part: int
    attributes: dict[str, Any]
    """Values that the store was made from, given by its creator."""
    digests: Mapping[str, str] = {}
    """Digest of each part of a finished store, so that a part of another store is refused."""

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
        self._groups: dict[tuple[int, str], tuple[zarr.Group, dict[str, Header]]] = {}
        self._arrays: dict[tuple[int, str, str], Any] = {}
        self._unfinished: dict[str, _Part] = {}
        self._claim = contextlib.ExitStack()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.header)

    @property
    def chunk(self) -> int:
        """Rows that are compressed together, the smallest unit of reading."""
        raise NotImplementedError

    @functools.cached_property
    def columns(self) -> Mapping[str, str]:
        """Type of each array of a part, by name."""
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

        `attributes` (plain JSON) must hold everything that the sequences depend on. One process creates the store and
        sends it to the others that write. ValueError while a store that another process created at `path` is
        unfinished. With an fsspec URL as `path`, the store lies there from the start; ValueError if another store does.
        """
        _check_names(sequences)
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
        store = cls(os.fspath(path) if is_url(path) else str(Path(path).with_name(Path(path).name + ".tmp")), header)
        if not is_url(path):
            store._claim.enter_context(claimed(Path(path)))
        begun = {**header, "code": code_digest()}
        if (known := _created(store.path)) != begun:
            if known is not None and is_url(path):
                raise ValueError(f"{path}: expected nothing there, or this store unfinished, got another; delete it")
            shutil.rmtree(store.path, ignore_errors=True)
        zarr.open_group(store.path, mode="a", zarr_format=3).attrs.put(begun)
        return store

    @classmethod
    def open(cls: type[S], path: str | os.PathLike[str]) -> S:
        """Open a finished store to read.

        `path` is a local folder or an fsspec URL. FileNotFoundError where there is nothing; ValueError for other
        content, another version, or an unfinished store.
        """
        if Path(path).is_file():
            raise ValueError(f"{path}: expected the folder of a store, got a file; unpack a zip or tar of a store")
        header = dict(open_group(path).attrs)
        if header.get("format") != cls.FORMAT:
            raise ValueError(f"{path}: expected a store of format {cls.FORMAT!r}, got {header.get('format')!r}")
        if header.get("version") != cls.VERSION:
            raise ValueError(
                f"{path}: expected version {cls.VERSION} of {cls.FORMAT}, got version {header.get('version')!r} of "
                "another polarnet; run `dvc repro`, which writes it again"
            )
        if "digests" not in header:
            raise ValueError(f"{path}: the store was never finished; run the stage that writes it again")
        if header.get("checksum") != _checksum(header):
            raise ValueError(f"{path}: the attributes in zarr.json are not what was written; {REPAIR}")
        try:
            store = cls(os.fspath(path), header)
            _check_names(store.sequences)
            if not store.columns or set(store.digests) != set(store.parts):
                raise ValueError("expected a digest of every part")
        except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError) as error:
            raise ValueError(
                f"{path}: the attributes in zarr.json are not those of a store: {error}; {REPAIR}"
            ) from error
        return store

    def missing(self) -> list[str]:
        """Sequences of the parts that are not written yet, in the store's order."""
        return [sequence for part in self.missing_parts() for sequence in self.parts[part]]

    def missing_parts(self) -> list[str]:
        """Parts that are not written yet."""
        return [part for part in self.parts if not self._is_whole(part)]

    def is_written(self, sequence: str) -> bool:
        """Whether the part of a sequence is complete."""
        return self._is_whole(self.part_of(sequence))

    def part_of(self, sequence: str) -> str:
        """Name of the part that holds a sequence; ValueError if the store lacks the sequence."""
        if sequence not in self._part_of:
            raise ValueError(f"{self.path}: {unknown_sequence(sequence, self.sequences)}")
        return self._part_of[sequence]

    def append(
        self,
        sequence: str,
        columns: Mapping[str, np.ndarray],
        record: Mapping[str, Any],
        rows_of: str | None = None,
    ) -> None:
        """Add the next sequence to its part: rows of every column, and a `record` of plain JSON.

        With `rows_of`, an earlier sequence of the part, both have the rows of that one, and `columns` is ignored. The
        sequences of a part come in the store's order, from one process; ValueError for another order. The first one
        starts the part anew, the last one completes it. OSError after a part if the disk has no room for the missing
        parts, assumed to be as large as this one.
        """
        part = self.part_of(sequence)
        names = self.parts[part]
        if sequence == names[0]:
            self._unfinished[part] = _Part(self._url(part), self.chunk)
        expected = names[len(self._unfinished[part].records)] if part in self._unfinished else names[0]
        if sequence != expected:
            raise ValueError(f"{self.path}: {part} takes its sequences in order, expected {expected}, got {sequence}")
        if rows_of is None:
            columns = {name: np.asarray(columns[name], dtype) for name, dtype in self.columns.items()}
        self._unfinished[part].append(sequence, columns, record, rows_of)
        if sequence == names[-1]:
            size = self._unfinished.pop(part).finish()
            if not is_url(self.path):
                missing = len(self.parts) - len(list(Path(self.path).glob("part-?????")))
                check_room(Path(self.path), missing * size, f"the {missing} missing parts")

    def finish(self) -> None:
        """Mark the store complete and move it from PATH.tmp to PATH; ValueError where sequences are missing."""
        if missing := self.missing():
            raise ValueError(
                f"{self.path}: {len(missing)} not written yet: {', '.join(missing[:8])}; write them, then finish"
            )
        header = {**self.header, "digests": {part: _digest(self._url(part, METADATA)) for part in self.parts}}
        zarr.open_group(self.path, mode="r+").attrs.put({**header, "checksum": _checksum(header)})
        if is_url(self.path):
            return
        for leftover in [*Path(self.path).glob("*.tmp"), *Path(self.path).glob("*.partial")]:  # of killed processes
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        publish(Path(self.path), Path(self.path.removesuffix(".tmp")))
        self._claim.close()

    def record(self, sequence: str) -> Header:
        """Record of a stored sequence, with [start, stop] of its `rows`; ValueError if unreadable."""
        part = self.part_of(sequence)
        try:
            _, records = self._opened(part)
            return records[sequence]
        except Exception as error:  # Zarr raises many kinds of exceptions
            raise_unreadable(error, f"{self.path}: {sequence}, {part}")

    def read_column(self, name: str, sequence: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows of a sequence from `start` up to `stop` (None: the end); ValueError names an unreadable column."""
        part, record = self.part_of(sequence), self.record(sequence)
        try:
            first, end = record["rows"]
            rows = slice(first + start, end if stop is None else min(first + stop, end))
            group, _ = self._opened(part)
            key = os.getpid(), part, name
            if key not in self._arrays:
                self._arrays[key] = group[name]
            values = np.asarray(self._arrays[key][rows])
            if len(values) != max(0, rows.stop - rows.start):
                raise ValueError(f"expected rows {rows.start} to {rows.stop}, got {len(values)} of them")
        except Exception as error:  # each codec raises its own exceptions
            raise_unreadable(error, f"{self.path}: {sequence}, column {name} of {part}")
        return values

    def read_columns(self, sequence: str, requests: Sequence[tuple[str, int, int | None]]) -> list[np.ndarray]:
        """`read_column` for several (name, start, stop), at the same time."""
        with ThreadPoolExecutor(len(requests)) as pool:
            return list(pool.map(lambda request: self.read_column(request[0], sequence, *request[1:]), requests))

    @classmethod
    def verify(cls, path: str | os.PathLike[str]) -> list[str]:
        """A message for each damaged file of a store, with its sequences; empty if every byte is as it was written."""
        try:
            store = cls.open(path)
        except (FileNotFoundError, ValueError) as error:
            return [str(error)]
        return [
            f"{path}: {file} is not as it was written; it holds {', '.join(names)}; {REPAIR}"
            for part, names in store.parts.items()
            for file in store._changed_files(part)
        ]

    def _changed_files(self, part: str) -> list[str]:
        """Files of a part whose SHA-256 is not the one that was written."""
        try:
            group, _ = self._opened(part)
        except ValueError:
            return [f"{part}/{METADATA}"]
        digests: Any = group.attrs["sha256"]
        return [f"{part}/{file}" for file, digest in digests.items() if _digest(self._url(part, file)) != digest]

    def _is_whole(self, part: str) -> bool:
        files, name = fsspec.url_to_fs(self._url(part, METADATA))
        return files.exists(name)

    def _url(self, *names: str) -> str:
        """Path or fsspec URL of a part, or of a file of a part."""
        return "/".join((self.path, *names))

    def _opened(self, part: str) -> tuple[zarr.Group, dict[str, Header]]:
        """Group of a part, and the records of its sequences; each process opens its own."""
        key = os.getpid(), part
        if key not in self._groups:
            if part in self.digests and _digest(self._url(part, METADATA)) != self.digests[part]:
                raise ValueError("it is not the part that was written into this store")
            group = open_group(self._url(part))
            written: Any = group.attrs["sequences"]
            self._groups[key] = group, {name: dict(written[name]) for name in self.parts[part]}
        return self._groups[key]


class _Part:
    """A part that one process writes, under a temporary name until it is complete."""

    def __init__(self, path: str, chunk: int):
        self.path = path
        self.records: dict[str, Header] = {}
        self._chunk = chunk
        folder = tempfile.gettempdir() if is_url(path) else os.path.dirname(path)
        self._temporary = Path(folder, f"{os.path.basename(path)}.{uuid.uuid4().hex}.tmp")
        self._columns = GrowingColumns(self._temporary, chunk, sharded=True, conventions={})
        self._stop = 0

    def append(
        self, sequence: str, columns: Mapping[str, np.ndarray], record: Mapping[str, Any], rows_of: str | None
    ) -> None:
        """Add the rows of a sequence, and hold its record until `finish`."""
        if rows_of is not None:
            self.records[sequence] = {**record, "rows": self.records[rows_of]["rows"]}
            return
        (rows,) = {len(values) for values in columns.values()}
        padding = -rows % self._chunk
        self._columns.append(
            {
                name: np.concatenate([values, np.zeros((padding, *values.shape[1:]), values.dtype)])
                for name, values in columns.items()
            }
        )
        self.records[sequence] = {**record, "rows": [self._stop, self._stop + rows]}
        self._stop += rows + padding

    def finish(self) -> int:
        """Write the metadata, give the part its name and return its size in bytes.

        Another process may have given the name to the same bytes.
        """
        self._columns.flush()
        files = sorted(path for path in self._temporary.rglob("*") if path.is_file())
        digests = {
            path.relative_to(self._temporary).as_posix(): sha256(path)
            for path in files
            if path != self._temporary / METADATA
        }
        group = zarr.open_group(self._temporary, mode="r+")
        group.attrs.put({"sequences": self.records, "sha256": digests})
        size = sum(path.stat().st_size for path in files)
        if is_url(self.path):
            bucket, name = fsspec.url_to_fs(self.path)
            for file in [*digests, METADATA]:
                bucket.makedirs(os.path.dirname(f"{name}/{file}"), exist_ok=True)
                bucket.put_file(str(self._temporary / file), f"{name}/{file}")
        else:
            try:
                os.rename(self._temporary, self.path)
            except OSError:
                if not Path(self.path, METADATA).exists():
                    raise
        shutil.rmtree(self._temporary, ignore_errors=True)
        return size


def _digest(url: str) -> str | None:
    """SHA-256 of the file at a path or fsspec URL; None if it cannot be read."""
    digest = hashlib.sha256()
    try:
        with fsspec.open(url) as file:
            while block := file.read(2**20):
                digest.update(block)
    except OSError:
        return None
    return digest.hexdigest()


def unknown_sequence(sequence: str | None, sequences: list[str]) -> str:
    """Message about a sequence that a store does not have: it lists those that the store has."""
    listed = ", ".join(sequences[:MAX_LISTED])
    if len(sequences) > MAX_LISTED:
        listed += f", ... (`polarnet inspect` names all {len(sequences)})"
    return f"expected a sequence of {listed}; got {sequence!r}"


def _check_names(sequences: Sequence[str]) -> None:
    """ValueError unless the names of a store's sequences are at least one, each once, and safe in a path."""
    if not sequences:
        raise ValueError("expected at least one name, got none")
    if repeated := [name for name, times in Counter(map(check_name, sequences)).items() if times > 1]:
        raise ValueError(f"expected each name once, got {', '.join(repeated[:8])} again")


def _checksum(header: Header) -> str:
    """SHA-256 of a finished header without its checksum."""
    plain = {key: value for key, value in header.items() if key != "checksum"}
    return sha256(json.dumps(plain, sort_keys=True).encode())


def _created(path: str) -> Header | None:
    """The header that `create_parts` gave to a store; None if there is no store."""
    try:
        with fsspec.open(f"{path}/{METADATA}") as file:
            header = json.load(file)["attributes"]
        return {key: value for key, value in header.items() if key not in ("digests", "checksum")}
    except (OSError, ValueError, KeyError):
        return None
