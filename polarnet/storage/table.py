"""Create, resume, finish and open the Zarr v3 groups behind every store; their arrays have one row per name.

A store is written as PATH.tmp. Each row has its own files, so processes may write different rows at the same time. The
user of a table writes one column of a row last; a row without it counts as missing. Zarr's local store writes a
temporary file and renames it, so a killed process leaves a row missing, never damaged. `finish` sets the attribute
`complete` last and renames PATH.tmp to PATH. The same rows give the same bytes, in any order of writing.
"""

import asyncio
import hashlib
import itertools
import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.abc.store import RangeByteRequest
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec
from zarr.core.sync import sync
from zarr.storage import FsspecStore, LocalStore, ZipStore

COMPRESSION_LEVEL = 1  # for zstd; higher levels cost 10-100 times the time for 6 % fewer bytes
REPAIR = "write this store again, or copy it again from where it is whole"


@dataclass(frozen=True)
class Column:
    """One array of a table: a row of `shape` for each name in `rows`."""

    rows: Sequence[str]
    shape: tuple[int, ...]
    """Maximum size of a row; unused space takes no disk."""
    chunk: tuple[int, ...]
    """Unit of compression, and the smallest unit of reading."""
    shard: tuple[int, ...]
    """Unit of a file: a multiple of `chunk`."""
    dtype: str
    fill: int | float
    """Value wherever nothing was written."""
    fill_is_data: bool
    """Whether `fill` is also a valid value; chunks that hold nothing else are then written too."""
    shuffle: str
    """Shuffle of Blosc: shuffle (bytes) or bitshuffle."""


Columns = Mapping[str, Column]
Attributes = dict[str, Any]


class Table:
    """A group with its columns, made by `create_table` or `open_table`. It can be sent to other processes."""

    def __init__(self, path: str, group: zarr.Group, columns: Columns):
        self.path = path
        self.columns = columns
        self.attributes: Attributes = dict(group.attrs)
        self._arrays = {name: _array(path, group, name, column) for name, column in columns.items()}
        self._numbers = {name: {row: i for i, row in enumerate(c.rows)} for name, c in columns.items()}

    def write(self, name: str, row: str, values: np.ndarray) -> None:
        """Write `values` at the start of a row, and clear the rest of the row.

        Whole files are replaced. Leftovers of a killed process are therefore harmless, and so is another process that
        writes the same values at the same time.
        """
        array, number = self._arrays[name], self._number(name, row)
        sides = (array.shards or array.chunks)[1:]
        whole = [
            min(-(-n // side) * side, size) for n, side, size in zip(values.shape, sides, array.shape[1:], strict=True)
        ]
        padded = np.full(whole, self.columns[name].fill, array.dtype)
        padded[tuple(slice(n) for n in values.shape)] = values
        window = tuple(slice(n) for n in whole)
        place: tuple[int | slice, ...] = (number, *window)
        array[place] = padded
        folder, written = Path(self.path, name), self._files(name, row, window)
        for file in (folder / "c" / str(number)).rglob("*"):
            if file.is_file() and file.suffix != ".partial" and file.relative_to(folder).as_posix() not in written:
                file.unlink(missing_ok=True)

    def is_written(self, name: str, row: str) -> bool:
        """Whether a row exists in a local column with one file per row."""
        return all((Path(self.path, name) / key).exists() for key in self._files(name, row, ()))

    def read(self, name: str, row: str, *window: slice) -> np.ndarray:
        """Read a row or a `window` of it; ValueError that names row and column where it cannot be read."""
        return self.read_together([(name, row, window)])[0]

    def read_together(self, requests: Sequence[tuple[str, str, tuple[slice, ...]]]) -> list[np.ndarray]:
        """`read` several (column, row, window) concurrently."""

        async def gather() -> list[np.ndarray]:
            return await asyncio.gather(*(self._fetch(*request) for request in requests))

        return sync(gather())

    async def _fetch(self, name: str, row: str, window: tuple[slice, ...]) -> np.ndarray:
        array, number = self._arrays[name], self._number(name, row)
        try:
            if any((s.stop or 0) > size for s, size in zip(window, array.shape[1:], strict=False)):
                raise ValueError(f"its zarr.json says that rows end at {array.shape[1:]}")
            for key in self._files(name, row, window):
                first_byte = await (array.store_path / key).get(byte_range=RangeByteRequest(0, 1))
                if not first_byte:  # Zarr would read fill values
                    raise FileNotFoundError(f"there is no {key}, or nothing in it")
            return np.asarray(await array.async_array.getitem((number, *window)))
        except Exception as error:  # each codec raises its own exceptions
            raise ValueError(f"{self.path}: {row}, column {name} is unreadable: {error}; {REPAIR}") from error

    def finish(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Cut columns to the used row `shapes`, mark the table complete and move it to its final path."""
        for name, shape in shapes.items():
            _resize(self._arrays[name], shape)
        folder = Path(self.path)
        for leftover in folder.rglob("*.partial"):  # left by a process killed while writing a file
            leftover.unlink()
        header = {**self.attributes, "metadata_sha256": self._metadata_digests(), "complete": True}
        zarr.open_group(folder, mode="r+").attrs.put({**header, "checksum": _checksum(header)})
        final = folder.with_name(folder.name.removesuffix(".tmp"))
        replaced = final.with_name(final.name + ".old")
        shutil.rmtree(replaced, ignore_errors=True)
        if final.exists():
            os.replace(final, replaced)  # a folder cannot be renamed onto one that is not empty
        os.replace(folder, final)
        shutil.rmtree(replaced, ignore_errors=True)

    def metadata_problems(self) -> list[str]:
        """Messages about each column's zarr.json that changed since `finish`."""
        digests = self._metadata_digests()
        return [
            f"{self.path}: {name}/zarr.json is not as it was written; {REPAIR}"
            for name, digest in self.attributes["metadata_sha256"].items()
            if digests.get(name) != digest
        ]

    def _metadata_digests(self) -> dict[str, str]:
        """SHA-256 of the zarr.json of each column and of its parent groups."""
        group = open_group(self.path)
        names = {*self.columns, *(name.rpartition("/")[0] for name in self.columns)} - {""}
        texts = {name: sync((group.store_path / name / "zarr.json").get()) for name in sorted(names)}
        return {name: hashlib.sha256(text.to_bytes() if text else b"").hexdigest() for name, text in texts.items()}

    def _number(self, name: str, row: str) -> int:
        if row not in self._numbers[name]:
            raise ValueError(f"{self.path}: there is no {row!r} among its {len(self._numbers[name])} rows of {name}")
        return self._numbers[name][row]

    def _files(self, name: str, row: str, window: Sequence[slice]) -> list[str]:
        """Keys, relative to the column, of the files that hold a window of a row."""
        array = self._arrays[name]
        spans = [s.indices(size)[:2] for s, size in zip(window, array.shape[1:], strict=False)]
        spans += [(0, size) for size in array.shape[1 + len(spans) :]]
        sides = (array.shards or array.chunks)[1:]
        grid = [range(start // side, -(-stop // side)) for (start, stop), side in zip(spans, sides, strict=True)]
        number = self._number(name, row)
        return [array.metadata.encode_chunk_key((number, *place)) for place in itertools.product(*grid)]


def check_names(names: Sequence[str]) -> None:
    """ValueError unless there is at least one name and all are distinct."""
    if not names:
        raise ValueError("expected at least one name, got none")
    repeated = [name for name, times in Counter(names).items() if times > 1]
    if repeated:
        raise ValueError(f"expected each name once, got {', '.join(repeated[:8])} again")


def refuse_missing(path: str, missing: Sequence[str]) -> None:
    """ValueError that states the number of missing sequences and names the first few."""
    if missing:
        raise ValueError(f"{path}: {len(missing)} not written yet: {', '.join(missing[:8])}; write them, then finish")


def create_table(
    path: str | os.PathLike[str], form: str, version: int, attributes: Mapping[str, Any], columns: Columns
) -> Table:
    """Create a table to write at PATH.tmp, or resume the unfinished one there if its attributes are equal.

    One process creates the table and sends it to the others that write.
    """
    folder = Path(path).with_name(Path(path).name + ".tmp")
    header = _header(form, version, attributes)
    if _header_on_disk(folder) != header:
        shutil.rmtree(folder, ignore_errors=True)
        _lay_out(folder, header, columns)
    group = zarr.open_group(folder, mode="r+")
    group.attrs.put(header)  # resets `complete`, which a process killed in `finish` may have set
    table = Table(str(folder), group, columns)
    for name, column in columns.items():
        _resize(table._arrays[name], column.shape)
    return table


def open_table(
    path: str | os.PathLike[str], form: str, version: int, columns_of: Callable[[Attributes], Columns]
) -> Table:
    """Open a finished table to read; `columns_of(attributes)` returns its columns.

    `path` is a local folder, a zip of one (its zarr.json at the top, as `cd STORE; zip -r0 ../STORE.zip .` makes it),
    or an fsspec URL. FileNotFoundError where there is nothing; ValueError for other content, another version, or an
    unfinished table.
    """
    group = open_group(path)
    header = dict(group.attrs)
    if header.get("format") != form:
        raise ValueError(f"{path}: expected a store of format {form!r}, got {header.get('format')!r}")
    if header.get("version") != version:
        raise ValueError(
            f"{path}: this polarnet reads version {version} of {form}, the store is of version "
            f"{header.get('version')}; use the polarnet that wrote it (a newer version: upgrade), or write it again"
        )
    if header.get("complete") is not True:
        raise ValueError(f"{path}: the store was never finished; run the stage that writes it again")
    if header.get("checksum") != _checksum(header):
        raise ValueError(f"{path}: the attributes in zarr.json are not what was written; {REPAIR}")
    return Table(os.fspath(path), group, columns_of(header))


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
        return zarr.open_group(store, mode="r", zarr_format=3)
    except FileNotFoundError:
        unfinished = f" ({name}.tmp is unfinished)" if Path(f"{name}.tmp").exists() else ""
        raise FileNotFoundError(
            f"{name}: there is no Zarr v3 group{unfinished}; run the stage that writes it"
        ) from None
    except ImportError:  # a package for reading URLs is missing
        raise
    except Exception as error:  # Zarr raises many kinds of exceptions for a damaged zarr.json
        raise ValueError(f"{name} is unreadable: {error}; {REPAIR}") from error


def _header(form: str, version: int, attributes: Mapping[str, Any]) -> Attributes:
    """The attributes of an unfinished group, as read back from disk."""
    try:
        header = json.loads(json.dumps({"format": form, "version": version, **attributes}, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"the attributes of a store must be finite, plain JSON: {error}") from None
    header["complete"] = False
    return {**header, "checksum": _checksum(header)}


def _checksum(header: Attributes) -> str:
    signed = {key: value for key, value in header.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(signed, sort_keys=True).encode()).hexdigest()


def _header_on_disk(folder: Path) -> Attributes | None:
    """The header of a table as it was before `finish`; None if there is no table."""
    try:
        header = json.loads((folder / "zarr.json").read_text())["attributes"]
    except (OSError, ValueError, KeyError):
        return None
    header.pop("metadata_sha256", None)
    header["complete"] = False
    return {**header, "checksum": _checksum(header)}


def _lay_out(folder: Path, header: Attributes, columns: Columns) -> None:
    """Create the empty arrays, then the group's header: a folder without a header is no table."""
    group = zarr.open_group(folder, mode="w", zarr_format=3)
    for name, column in columns.items():
        _create_array(group, name, column)
    group.attrs.put(header)


def _create_array(group: zarr.Group, name: str, column: Column) -> zarr.Array:
    dtype = np.dtype(column.dtype)
    blosc = BloscCodec(
        typesize=dtype.itemsize, cname="zstd", clevel=COMPRESSION_LEVEL, shuffle=BloscShuffle(column.shuffle)
    )
    return group.create_array(
        name,
        shape=(len(column.rows), *column.shape),
        chunks=(1, *column.chunk),
        shards=None if column.shard == column.chunk else (1, *column.shard),
        dtype=dtype,
        fill_value=column.fill,
        compressors=[blosc, Crc32cCodec()],
    )


def _array(path: str, group: zarr.Group, name: str, column: Column) -> zarr.Array:
    try:
        array = group[name]
        if not isinstance(array, zarr.Array) or array.shape[0] != len(column.rows):
            raise ValueError("it is not an array with as many rows as there are names")
    except Exception as error:
        raise ValueError(f"{path}: {name}/zarr.json is unreadable: {error}; {REPAIR}") from error
    return array.with_config({"write_empty_chunks": column.fill_is_data})


def _resize(array: zarr.Array, row_shape: tuple[int, ...]) -> None:
    shape = (array.shape[0], *row_shape)
    if array.shape != shape:
        sync(array.async_array.resize(shape, delete_outside_chunks=False))  # searching for outside chunks takes minutes
