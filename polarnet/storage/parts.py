"""The layout of every store, a folder of parts: how one is created, resumed, finished, read and verified.

    NAME.zarr/zarr.json                header: format, version, names of the sequences, attributes, digest of each part
    NAME.zarr/part-00000/zarr.json     record of each sequence of the part: its rows in the columns, its own metadata;
                                       SHA-256 of each other file of the part, so that the part's digest is that of this
    NAME.zarr/part-00000/t/zarr.json   one column: the rows of these sequences, one sequence after the other
    NAME.zarr/part-00000/t/c/0         its shard; a column of many megabytes has several
    NAME.zarr/part-00000/MAP/SEQUENCE  an array of one sequence that is no column

Every sequence starts a chunk of its own, so that reading one decodes nothing of its neighbours; the rows between two
sequences are 0. A store is written as NAME.zarr.tmp. One process writes a part, under a temporary name, and renames it
when it is complete. After a kill a part is whole or missing, and a rerun makes the missing parts, if its header and
its code (`code_digest`) are those that began the store. At an fsspec URL nothing is renamed: a part is whole once it
has its zarr.json, which is copied last. The same sequences give the same bytes, in any order of the parts.
"""

import contextlib
import functools
import hashlib
import json
import os
import shutil
import tempfile
import unicodedata
import uuid
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar, get_origin, get_type_hints

import fsspec
import numpy as np
import zarr
from pydantic import PositiveInt
from zarr.codecs import Crc32cCodec, ZstdCodec

from polarnet.runtime.files import (
    check_name,
    check_room,
    claimed,
    code_digest,
    named_shortage,
    publish,
    sha256,
    to_disk,
)
from polarnet.runtime.sections import section, section_of
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
    """Named sequences in parts. A subclass declares format, version and chunk, and adds its own keys to the header.

    A key of the header that a class annotates is an attribute of the store, checked as in a section of params.yaml. A
    store can be sent to other processes.
    """

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int]
    chunk: ClassVar[int]
    """Rows that are compressed together, the smallest unit of reading."""
    sequences: list[str]
    sequences_per_part: PositiveInt
    attributes: dict[str, Any]
    """Values that the store was made from, given by its creator."""
    digests: dict[str, str]
    """Digest of each part of a finished store, so that a part of another store is refused."""

    def __init__(self, path: str, header: Header):
        kind: Any = type(self)
        known, keys = {"digests": {}, **header}, _header_class(kind)
        vars(self).update(vars(keys(**{name: known[name] for name in keys.__dataclass_fields__ if name in known})))
        self.path, self.header = path, header
        _check_names(self.sequences)
        starts = range(0, len(self.sequences), self.sequences_per_part)
        self.parts: dict[str, list[str]] = {
            f"part-{number:05d}": self.sequences[start : start + self.sequences_per_part]
            for number, start in enumerate(starts)
        }
        """Names of the sequences in each part."""
        self._part_of = {sequence: part for part, names in self.parts.items() for sequence in names}
        self._opened: dict[tuple[int, str], tuple[zarr.Group, dict[str, Header], dict[str, Any]]] = {}
        self._unfinished: dict[str, _Part] = {}
        self._claim = contextlib.ExitStack()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.header)

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
        header = {
            "format": cls.FORMAT,
            "version": cls.VERSION,
            "sequences": list(sequences),
            "sequences_per_part": sequences_per_part,
            **metadata,
            "attributes": dict(attributes),
        }
        header = json.loads(json.dumps(header, allow_nan=False))  # as read back from disk
        store = cls(os.fspath(path) if is_url(path) else f"{Path(path)}.tmp", header)
        if not is_url(path):
            store._claim.enter_context(claimed(Path(path)))
        begun = {**header, "code": code_digest()}
        known: Header = {}
        with contextlib.suppress(FileNotFoundError, ValueError):  # nothing there, or damaged
            known = dict(open_group(store.path).attrs)
        if known != begun:
            if known and is_url(path):
                raise ValueError(f"{path}: expected nothing there, or this store unfinished, got another; delete it")
            shutil.rmtree(store.path, ignore_errors=True)
        with named_shortage(Path(store.path)):
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
        if "checksum" not in header:
            raise ValueError(f"{path}: the store was never finished; run the stage that writes it again")
        if header["checksum"] != _checksum(header):
            raise ValueError(f"{path}: the attributes in zarr.json are not what was written; {REPAIR}")
        try:
            store = cls(os.fspath(path), header)
        except ValueError as error:
            words = "; ".join(str(error).splitlines())
            raise ValueError(f"{path}: the attributes in zarr.json are not a store's: {words}; {REPAIR}") from error
        if store.digests.keys() != store.parts.keys():
            raise ValueError(f"{path}: expected digests of {len(store.parts)} parts, got others; {REPAIR}")
        return store

    def missing(self) -> list[str]:
        """Sequences of the parts that are not written yet, in the store's order."""
        return [sequence for part in self.missing_parts() for sequence in self.parts[part]]

    def missing_parts(self) -> list[str]:
        """Parts that are not written yet."""
        return [part for part in self.parts if not self._is_whole(part)]

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
        maps: Mapping[str, np.ndarray] = MappingProxyType({}),
    ) -> None:
        """Add the next sequence to its part: rows of every column, a `record` of plain JSON, and arrays without rows.

        The sequences of a part come in the store's order, from one process; ValueError for another order. The first one
        starts the part anew, the last one completes it; a part that is complete stays unchanged. OSError after a part
        if the disk has no room for the missing parts, assumed to be as large as this one.
        """
        part = self.part_of(sequence)
        names, begun = self.parts[part], self._unfinished.get(part)
        if begun is None and self._is_whole(part):
            return
        if sequence == names[0]:
            begun = self._unfinished[part] = _Part(self._url(part), self.chunk)
        expected = names[len(begun.records)] if begun else names[0]
        if begun is None or sequence != expected:
            raise ValueError(f"{self.path}: {part} takes its sequences in order, expected {expected}, got {sequence}")
        with named_shortage(Path(self.path)):
            begun.add_sequence(sequence, columns, record)
            begun.maps |= {f"{name}/{sequence}": values for name, values in maps.items()}
            size = self._unfinished.pop(part).finish() if sequence == names[-1] else 0
        if size and not is_url(self.path):
            missing = len(self.parts) - len(list(Path(self.path).glob("part-?????")))
            check_room(Path(self.path), missing * size, f"the {missing} missing parts")

    def finish(self) -> None:
        """Mark the store complete and move it from PATH.tmp to PATH; ValueError where sequences are missing."""
        if missing := self.missing():
            raise ValueError(
                f"{self.path}: {len(missing)} not written yet: {', '.join(missing[:8])}; write them, then finish"
            )
        header = {**self.header, "digests": {part: _digest(self._url(part, METADATA)) for part in self.parts}}
        if not is_url(self.path):
            for leftover in [*Path(self.path).glob("*.tmp"), *Path(self.path).glob("*.partial")]:  # of killed processes
                shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
            to_disk(Path(self.path))  # takes seconds, in which the header still lets a rerun go on
        with named_shortage(Path(self.path)):
            zarr.open_group(self.path, mode="r+").attrs.put({**header, "checksum": _checksum(header)})
        if not is_url(self.path):
            publish(Path(self.path), Path(self.path.removesuffix(".tmp")))
            self._claim.close()

    def record(self, sequence: str) -> Header:
        """Record of a stored sequence, with [start, stop] of its `rows`; ValueError if unreadable."""
        _, records, _ = self._open_part(sequence)
        return records[sequence]

    def read_column(self, name: str, sequence: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows of a sequence from `start` up to `stop` (None: the end); ValueError names an unreadable column."""
        first, end = self.record(sequence)["rows"]
        start, stop = first + start, end if stop is None else min(first + stop, end)
        values = self.read_array(name, sequence, slice(start, stop))
        if len(values) != max(0, stop - start):
            error = ValueError(f"expected rows {start} to {stop}, got {len(values)} of them")
            raise_unreadable(error, f"{self.path}: {sequence}, column {name} of {self.part_of(sequence)}")
        return values

    def read_array(self, name: str, sequence: str, rows: Any = ...) -> np.ndarray:
        """An array of a sequence's part, or some rows of it; ValueError names an unreadable one."""
        group, _, arrays = self._open_part(sequence)
        try:
            if name not in arrays:
                if changed := [] if is_url(self.path) else self._changed(self.part_of(sequence), group, name):
                    raise ValueError(f"{changed[0]} is not the file that was written")
                arrays[name] = group[name]
            return np.asarray(arrays[name][rows])
        except Exception as error:  # each codec raises its own exceptions
            raise_unreadable(error, f"{self.path}: {sequence}, column {name} of {self.part_of(sequence)}")

    def read_columns(
        self, sequence: str, names: Collection[str], spans: Sequence[tuple[int, int | None]] = ((0, None),)
    ) -> list[dict[str, np.ndarray]]:
        """The columns by name for each of the spans (start, stop) of a sequence's rows, all read at the same time."""
        requests = [(name, sequence, *span) for span in spans for name in names]
        with ThreadPoolExecutor(len(requests)) as pool:
            values = pool.map(lambda request: self.read_column(*request), requests)
            return [{name: next(values) for name in names} for _ in spans]

    @classmethod
    def verify(cls, path: str | os.PathLike[str]) -> list[str]:
        """A message for each damaged file of a store, with its sequences; empty if every byte is as it was written."""
        try:
            store = cls.open(path)
        except (FileNotFoundError, ValueError) as error:
            return [str(error)]
        problems = []
        for part, names in store.parts.items():
            try:
                changed = store._changed(part, store._open_part(names[0])[0])
            except ValueError:
                changed = [METADATA]
            about = f"is not as it was written; it holds {', '.join(names)}; {REPAIR}"
            problems += [f"{path}: {part}/{file} {about}" for file in changed]
        return problems

    def _changed(self, part: str, group: zarr.Group, column: str = "") -> list[str]:
        """Files of a part, or of one column, that are not those that were written."""
        digests: Any = group.attrs["sha256"]
        files = (file for file in digests if not column or file.startswith(f"{column}/"))
        return [file for file in files if _digest(self._url(part, file)) != digests[file]]

    def _is_whole(self, part: str) -> bool:
        files, name = fsspec.url_to_fs(self._url(part, METADATA))
        return files.exists(name)

    def check_record(self, sequence: str, record: Header) -> None:
        """ValueError for a record that no writer makes."""
        start, stop = record["rows"]
        if not 0 <= start <= stop:
            raise ValueError(f"{sequence}: expected a span of rows, got {start} to {stop}")

    def _url(self, *names: str) -> str:
        """Path or fsspec URL of a part, or of a file of a part."""
        return "/".join((self.path, *names))

    def _open_part(self, sequence: str) -> tuple[zarr.Group, dict[str, Header], dict[str, Any]]:
        """Part of a sequence: group, record of each sequence, columns opened so far. Each process opens its own."""
        part = self.part_of(sequence)
        key = os.getpid(), part
        if key not in self._opened:
            try:
                if self.digests and _digest(self._url(part, METADATA)) != self.digests[part]:
                    raise ValueError("it is not the part that was written into this store")
                group = open_group(self._url(part))
                written: Any = group.attrs["sequences"]
                records = {name: dict(written[name]) for name in self.parts[part]}
                for name, record in records.items():
                    self.check_record(name, record)
                self._opened[key] = group, records, {}
            except Exception as error:  # Zarr raises many kinds of exceptions
                raise_unreadable(error, f"{self.path}: {sequence}, {part}")
        return self._opened[key]


class _Part(GrowingColumns):
    """A part that one process writes, under a temporary name until it is complete."""

    def __init__(self, url: str, chunk: int):
        folder, name = (tempfile.gettempdir() if is_url(url) else os.path.dirname(url)), os.path.basename(url)
        super().__init__(Path(folder, f"{name}.{uuid.uuid4().hex}.tmp"), chunk, sharded=True)
        self.url, self.stop = url, 0
        self.records: dict[str, Header] = {}
        self.maps: dict[str, np.ndarray] = {}

    def add_sequence(self, sequence: str, columns: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> None:
        """Add the rows of a sequence, filled up to whole chunks with 0, and hold its record until `finish`."""
        (rows,) = {len(values) for values in columns.values()}
        padding = -rows % self.chunk
        self.append(columns)
        self.append({name: np.zeros((padding, *one.shape[1:]), one.dtype) for name, one in columns.items()})
        self.records[sequence] = {**record, "rows": [self.stop, self.stop + rows]}
        self.stop += rows + padding

    def finish(self) -> int:
        """Write the metadata, give the part its name and return its size in bytes.

        Another process may have given the name to the same bytes.
        """
        self.flush()
        group = zarr.open_group(self.path, mode="r+")
        for name, values in self.maps.items():
            group.create_array(name, data=values, chunks=values.shape, compressors=[ZstdCodec(), Crc32cCodec()])
        files = sorted(path for path in self.path.rglob("*") if path.is_file())
        digests = {path.relative_to(self.path).as_posix(): sha256(path) for path in files}
        del digests[METADATA]
        group.attrs.put({"sequences": self.records, "sha256": digests})
        size = sum(path.stat().st_size for path in files)
        if is_url(self.url):
            bucket, name = fsspec.url_to_fs(self.url)
            for file in [*digests, METADATA]:
                bucket.makedirs(os.path.dirname(f"{name}/{file}"), exist_ok=True)
                bucket.put_file(str(self.path / file), f"{name}/{file}")
        else:
            try:
                os.rename(self.path, self.url)
            except OSError:
                if not Path(self.url, METADATA).exists():
                    raise
        shutil.rmtree(self.path, ignore_errors=True)
        return size


def _digest(url: str) -> str | None:
    """SHA-256 of the file at a path or fsspec URL; None if it cannot be read."""
    try:
        if not (is_url(url) or os.path.isfile(url)):  # a pipe or a device would not end
            return None
        with fsspec.open(url) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


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
    alike = Counter(unicodedata.normalize("NFC", check_name(name)) for name in sequences)
    if repeated := [name for name, times in alike.items() if times > 1]:
        raise ValueError(f"expected each name once, got {', '.join(repeated[:8])} again")


@functools.cache
def _header_class(store: type[Any]) -> Any:
    """Section of the keys that a kind of store annotates."""
    hints = get_type_hints(store, include_extras=True)
    return section_of(store.__name__, {name: hint for name, hint in hints.items() if get_origin(hint) is not ClassVar})


def _checksum(header: Header) -> str:
    """SHA-256 of a finished header without its checksum."""
    plain = {key: value for key, value in header.items() if key != "checksum"}
    return sha256(json.dumps(plain, sort_keys=True).encode())
