"""Tasks of HDF5; see `isolated_worker`."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import h5py
import numpy as np

with contextlib.suppress(ImportError):
    import hdf5plugin  # noqa: F401  # the compression of DSEC's own files


def describe(path: str, tables: Sequence[str], attributes: Sequence[str]) -> Iterator[tuple[dict[str, Any], list]]:
    """Shape, number kind and field names of each existing table, and values of existing scalars and attributes."""
    shapes, values = {}, {}
    with h5py.File(path, "r") as file:
        for key in tables:
            if isinstance(table := file.get(key), h5py.Dataset) and table.shape is not None:
                shapes[key] = (tuple(map(int, table.shape)), table.dtype.kind, table.dtype.names or ())
        for key in attributes:
            if key in file.attrs:
                values[key] = _plain(np.asarray(file.attrs[key]))
            elif isinstance(scalar := file.get(key), h5py.Dataset) and scalar.shape == ():
                values[key] = _plain(np.asarray(scalar[()]))
    yield {"tables": shapes, "values": values}, []


def read(
    path: str, columns: Sequence[tuple[str, str | int | None]], block_rows: int
) -> Iterator[tuple[None, list[np.ndarray]]]:
    """Columns in blocks of rows: of each table the whole, a field of its records, or a column by number."""
    with h5py.File(path, "r") as file:
        for start in range(0, len(file[columns[0][0]]), block_rows):
            rows = {name: file[name][start : start + block_rows] for name in dict(columns)}
            yield None, [_column(rows[name], part) for name, part in columns]


def _column(rows: np.ndarray, part: str | int | None) -> np.ndarray:
    return rows if part is None else rows[part] if isinstance(part, str) else rows[:, part]


def _plain(value: np.ndarray) -> Any:
    """Python numbers for short numeric arrays, text for anything else."""
    return value.tolist() if value.dtype.kind in "iuf" and value.size <= 8 else str(value)[:80]


TASKS = {"describe": describe, "read": read}
