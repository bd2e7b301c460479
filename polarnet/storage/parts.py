"""The layout of every store, a folder of parts: how one is created, resumed, finished, read and verified.

    NAME.zarr/zarr.json            header: format, version, names of the sequences, attributes, SHA-256 of each part
    NAME.zarr/part-00000.zip       a part: a zip of a Zarr group
        zarr.json                  record of each sequence of the part: its rows in the columns, its own metadata
        events/t/...               one column: the rows of these sequences, one sequence after the other

The store and each of its parts are Zarr v3 groups, each column is an array. Every sequence starts a chunk of its own,
so that reading one decodes nothing of its neighbours. Chunks are compressed, so the zip stores them as they are.

A store is written as NAME.zarr.tmp. One process writes a part, under a temporary name, and renames it when it is
complete; different processes write different parts. After a kill a part is whole or missing, and a rerun makes the
missing parts. `finish` marks the store complete and renames it. At an fsspec URL nothing is renamed, because an object
of a bucket appears whole or not at all. The same sequences give the same bytes, in any order of the parts.
"""

import contextlib
import functools
import hashlib
import json
import os
import shutil
import tempfile
import uuid
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import fsspec
import numpy as np
import zarr
from pydantic import PositiveInt
from zarr.abc.buffer import Buffer
from zarr.storage import MemoryStore

from polarnet.runtime.files import check_room, claimed, sha256
from polarnet.runtime.sections import section
from polarnet.storage.groups import REPAIR, Columns, create_array, is_url, open_group, raise_shortage

DIGEST_LENGTH = 64  # characters of a SHA-256
MAX_OPEN_PARTS = 64  # an open part has a file descriptor and about 2 MB of directory
MAX_LISTED = 8  # names of sequences in a message

Header = dict[str, Any]
S = TypeVar("S", bound="Store")


@section
class StorageConfig:
    """Section `storage` of params.yaml."""

    sequences_per_part: PositiveInt
    labels: bool
    """Store the cause of each simulated event."""


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
    digests: Mapping[str, str] = {}
    """SHA-256 of each part of a finished store, so that a part of another store is refused."""

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
        self._opened = functools.lru_cache(MAX_OPEN_PARTS)(self._open)
        self._records: dict[str, Header] = {}
        self._unfinished: dict[str, _Part] = {}
        self._claim = contextlib.ExitStack()

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

        One process creates the store and sends it to the others that write. ValueError while a store that another
        process created at `path` is unfinished. With an fsspec URL as `path`, the store lies there from the start;
        ValueError if another store does.
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
        store = cls(os.fspath(path) if is_url(path) else str(Path(path).with_name(Path(path).name + ".tmp")), header)
        if not is_url(path):
            store._claim.enter_context(claimed(Path(path)))
        if (known := _unsigned(store.path)) != header:
            if known is not None and is_url(path):
                raise ValueError(f"{path}: expected nothing there, or this store unfinished, got another; delete it")
            shutil.rmtree(store.path, ignore_errors=True)
        zarr.open_group(store.path, mode="a", zarr_format=3).attrs.put(_signed({**header, "complete": False}))
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
        if header.get("complete") is not True:
            raise ValueError(f"{path}: the store was never finished; run the stage that writes it again")
        if not _is_signed(header):
            raise ValueError(f"{path}: the attributes in zarr.json are not what was written; {REPAIR}")
        try:
            store = cls(os.fspath(path), header)
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

    def finish(self) -> None:
        """Mark the store complete and move it from PATH.tmp to PATH; ValueError where sequences are missing."""
        if missing := self.missing():
            raise ValueError(
                f"{self.path}: {len(missing)} not written yet: {', '.join(missing[:8])}; write them, then finish"
            )
        digests = {part: self._written_digest(part) for part in self.parts}
        group = zarr.open_group(self.path, mode="r+")
        group.attrs.put(_signed({**self.header, "digests": digests, "complete": True}))
        if not is_url(self.path):
            self._rename()

    def _rename(self) -> None:
        """Move a finished store from PATH.tmp to PATH."""
        folder = Path(self.path)
        for leftover in [*folder.glob("*.tmp"), *folder.glob("*.partial")]:  # from processes killed while writing
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        final = folder.with_name(folder.name.removesuffix(".tmp"))
        replaced = final.with_name(final.name + ".old")
        shutil.rmtree(replaced, ignore_errors=True)
        if final.exists():
            os.replace(final, replaced)  # a folder cannot be renamed onto one that is not empty
        os.replace(folder, final)
        shutil.rmtree(replaced, ignore_errors=True)
        self._claim.close()

    def is_written(self, sequence: str) -> bool:
        """Whether the part of a sequence is complete."""
        return self._is_whole(self._part(sequence))

    def append(self, sequence: str, columns: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> None:
        """Add the next sequence to its part: rows of some columns, and a `record` of plain JSON.

        The sequences of a part come in the store's order, from one process; ValueError for another order. The first one
        starts the part anew, the last one completes it. OSError after a part if the disk has no room for the missing
        parts, assumed to be as large as the mean of the written ones.
        """
        part, written = self._part(sequence), len(self.records_so_far(sequence))
        names = self.parts[part]
        if sequence != names[written]:
            raise ValueError(
                f"{self.path}: {part} takes its sequences in order, expected {names[written]}, got {sequence}"
            )
        if not written:
            self._unfinished[part] = _Part(self._file(part), self.columns)
        self._unfinished[part].append(sequence, columns, record)
        if sequence == names[-1]:
            self._unfinished.pop(part).finish()
            if not is_url(self.path):
                self._check_room()

    def _check_room(self) -> None:
        sizes = [file.stat().st_size for file in Path(self.path).glob("part-*.zip")]
        missing = len(self.parts) - len(sizes)
        check_room(Path(self.path), missing * sum(sizes) // len(sizes), f"the {missing} missing parts")

    def records_so_far(self, sequence: str) -> dict[str, Header]:
        """Records of the sequences before `sequence` in its part, while this process writes it."""
        part = self._part(sequence)
        if part not in self._unfinished or sequence == self.parts[part][0]:
            return {}
        return self._unfinished[part].records

    def record(self, sequence: str) -> Header:
        """Record of a stored sequence, with [start, stop] of its rows for each axis; ValueError if unreadable."""
        part = self._part(sequence)
        if part not in self._records:
            try:
                group, _ = self._opened(os.getpid(), part)
                written: Any = group.attrs["sequences"]
                records = {name: dict(written[name]) for name in self.parts[part]}
            except Exception as error:  # Zarr raises many kinds of exceptions
                raise_shortage(error, self.path)
                raise ValueError(f"{self.path}: {sequence}, {part}.zip is unreadable: {error}; {REPAIR}") from error
            self._records[part] = records
        return self._records[part][sequence]

    def read_column(self, name: str, sequence: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows of a sequence from `start` up to `stop` (None: the end); ValueError names an unreadable column."""
        part, record = self._part(sequence), self.record(sequence)
        try:
            first, end = record[self.columns[name].axis]
            rows = slice(first + start, end if stop is None else min(first + stop, end))
            group, arrays = self._opened(os.getpid(), part)
            if name not in arrays:
                arrays[name] = group[name]
            values = np.asarray(arrays[name][rows])
            if len(values) != max(0, rows.stop - rows.start):
                raise ValueError(f"expected rows {rows.start} to {rows.stop}, got {len(values)} of them")
        except Exception as error:  # each codec raises its own exceptions
            raise_shortage(error, self.path)
            raise ValueError(
                f"{self.path}: {sequence}, column {name} is unreadable: {part}.zip: {error}; {REPAIR}"
            ) from error
        return values

    def read_columns(self, sequence: str, requests: Sequence[tuple[str, int, int | None]]) -> list[np.ndarray]:
        """`read_column` for several (name, start, stop), at the same time."""
        try:
            with ThreadPoolExecutor(len(requests)) as pool:
                return list(pool.map(lambda request: self.read_column(request[0], sequence, *request[1:]), requests))
        except RuntimeError as error:  # no thread started
            raise_shortage(error, self.path)
            raise

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
        for part in store.parts:
            try:
                with fsspec.open(store._file(part)) as file:
                    digest, written = _digests(file)
            except OSError:
                digest, written = b"", None
            if digest != written or digest.decode() != store.digests[part]:
                problems.append(f"{path}: {part}.zip is not as it was written; {REPAIR}")
        return problems

    def _part(self, sequence: str) -> str:
        if sequence not in self._part_of:
            raise ValueError(f"{self.path}: {unknown_sequence(sequence, self.sequences)}")
        return self._part_of[sequence]

    def _is_whole(self, part: str) -> bool:
        files, name = fsspec.url_to_fs(self._file(part))
        return files.exists(name)

    def _file(self, part: str) -> str:
        """Path or fsspec URL of a part."""
        return f"{self.path}/{part}.zip"

    def _open(self, process: int, part: str) -> tuple[zarr.Group, dict[str, Any]]:
        """Group of a part and a dict for its arrays, cached by process: forks must not share their parent's file."""
        file = self._file(part)
        if part in self.digests and self._written_digest(part) != self.digests[part]:
            raise ValueError("it is not the part that was written into this store")
        return open_group(f"zip::{file}" if is_url(file) else file), {}

    def _written_digest(self, part: str) -> str:
        """Digest that `_Part.finish` wrote at the end of a part."""
        with fsspec.open(self._file(part)) as file:
            file.seek(-DIGEST_LENGTH, os.SEEK_END)
            return file.read().decode("ascii", "replace")


class _Part:
    """A part that one process writes, under a temporary name until it is complete."""

    def __init__(self, path: str, columns: Columns):
        self.path = path
        self.records: dict[str, Header] = {}
        folder = tempfile.gettempdir() if is_url(path) else os.path.dirname(path)
        self._temporary = Path(folder, f"{os.path.basename(path)}.{uuid.uuid4().hex}.tmp")
        self._zip = zipfile.ZipFile(self._temporary, "w")
        self._entries: dict[str, Buffer] = {}
        self._group = zarr.create_group(MemoryStore(self._entries))
        self._columns = columns
        self._arrays = {name: create_array(self._group, name, column) for name, column in columns.items()}

    def append(self, sequence: str, columns: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> None:
        """Write the chunks of a sequence, and hold its record until `finish`."""
        rows = {}
        for name, values in columns.items():
            column, array = self._columns[name], self._arrays[name]
            start = array.shape[0]
            rows[column.axis] = [start, start + len(values)]
            padding = np.zeros((-len(values) % column.chunk, *column.shape), column.dtype)
            if len(values):
                array.append(np.concatenate([values, padding]))
        self.records[sequence] = {**record, **rows}
        self._pack([entry for entry in self._entries if not entry.endswith("zarr.json")])

    def finish(self) -> None:
        """Write the metadata last, then give the part its name; another process may have given it the same bytes."""
        self._group.attrs.put({"sequences": self.records})
        self._pack(list(self._entries))
        self._zip.comment = bytes(DIGEST_LENGTH)
        self._zip.close()
        with self._temporary.open("r+b") as file:
            digest, _ = _digests(file)
            file.seek(-DIGEST_LENGTH, os.SEEK_END)
            file.write(digest)
        if is_url(self.path):
            bucket, name = fsspec.url_to_fs(self.path)
            bucket.put_file(str(self._temporary), name)
            self._temporary.unlink()
        else:
            os.replace(self._temporary, self.path)

    def _pack(self, entries: list[str]) -> None:
        """Move entries from memory into the zip, in an order and with a date that do not depend on the run."""
        for entry in sorted(entries):
            self._zip.writestr(zipfile.ZipInfo(entry), self._entries.pop(entry).to_bytes())


def _digests(part: Any) -> tuple[bytes, bytes]:
    """SHA-256 of an open part up to the comment of its zip, and that comment; they differ if a byte is damaged."""
    digest, end = hashlib.sha256(), b""
    while block := part.read(2**20):
        block = end + block
        digest.update(block[:-DIGEST_LENGTH])
        end = block[-DIGEST_LENGTH:]
    return digest.hexdigest().encode(), end


def unknown_sequence(sequence: str | None, sequences: list[str]) -> str:
    """Message about a sequence that a store does not have: it lists those that the store has."""
    listed = ", ".join(sequences[:MAX_LISTED])
    if len(sequences) > MAX_LISTED:
        listed += f", ... (`polarnet inspect` names all {len(sequences)})"
    return f"expected a sequence of {listed}; got {sequence!r}"


def _signed(header: Header) -> Header:
    """The header with a checksum of the rest."""
    return {**header, "checksum": sha256(json.dumps(header, sort_keys=True).encode())}


def _is_signed(header: Header) -> bool:
    return _signed({key: value for key, value in header.items() if key != "checksum"}) == header


def _unsigned(path: str) -> Header | None:
    """The header that `create_parts` gave to a store; None if there is no store."""
    try:
        with fsspec.open(f"{path}/zarr.json") as file:
            header = json.load(file)["attributes"]
        return {key: value for key, value in header.items() if key not in ("digests", "complete", "checksum")}
    except (OSError, ValueError, KeyError):
        return None
