"""Tasks of the HDF5 process; see `isolated_worker`."""

import contextlib
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np

with contextlib.suppress(ImportError):
    import hdf5plugin  # noqa: F401  # the compression of DSEC's own files


files: dict[str, h5py.File] = {}
"""Open files by name."""


def describe(name: str, tables: list[str], attributes: list[str]) -> dict[str, Any]:
    """Shape and number kind of each existing table, and values of existing scalars and attributes."""
    shapes, values = {}, {}
    with h5py.File(name, "r") as file:
        for key in tables:
            if isinstance(table := file.get(key), h5py.Dataset) and table.shape is not None:
                shapes[key] = (tuple(map(int, table.shape)), table.dtype.kind)
        for key in attributes:
            if key in file.attrs:
                values[key] = plain(np.asarray(file.attrs[key]))
            elif isinstance(scalar := file.get(key), h5py.Dataset) and scalar.shape == ():
                values[key] = plain(np.asarray(scalar[()]))
    return {"tables": shapes, "values": values}


def read(name: str, tables: list[str], start: int, stop: int) -> list[np.ndarray]:
    """Rows from start to stop of each table; the file stays open."""
    if name not in files:
        files[name] = h5py.File(name, "r")
    return [files[name][table][start:stop] for table in tables]


def close(name: str) -> None:
    """Close the file."""
    if name in files:
        files.pop(name).close()


TASKS: dict[str, Callable[..., Any]] = {"describe": describe, "read": read, "close": close}


def plain(value: np.ndarray) -> Any:
    """Python numbers for short numeric arrays, text for anything else."""
    return value.tolist() if value.dtype.kind in "iuf" and value.size <= 8 else str(value)[:80]
