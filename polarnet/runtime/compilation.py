"""Compilation of kernels with numba: cached on disk, without the interpreter's lock."""

import contextlib
import functools
import inspect
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np

_RUNNING = threading.Lock()
ZERO = np.int64(0)
"""0 as an int64 argument of kernels: numba would compile a kernel once for a literal and once more for int64."""


def compiled(kernel: Callable, **options: Any) -> Any:
    """Compile a kernel on its first call."""
    bare = inspect.unwrap(kernel)  # tests wrap a type checker around every function
    return numba.njit(nogil=True, cache=True, error_model="numpy", **options)(bare)


def borrowing(kernel: Callable) -> Any:
    """Compile a kernel that makes and returns no arrays, without reference counts.

    The counts of array slices are atomic, and cost up to 9 % of an emulation.
    """
    return compiled(kernel, _nrt=False)


def inlined(kernel: Callable) -> Any:
    """Compile a small kernel into each kernel that calls it."""
    return compiled(kernel, inline="always")


def parallel(kernel: Callable, **options: Any) -> Any:
    """Compile a kernel whose `prange` loops threads share.

    One runs at a time: where there is no OpenMP, numba's own threads end the process if two calls meet. The OpenMP
    layer uses the thread pool of torch, which must be imported before; threads of a second pool would wait for cores
    on which idle torch threads spin.
    """
    shared = compiled(kernel, parallel=True, **options)

    @functools.wraps(kernel)
    def alone(*arguments):
        with _RUNNING:
            shared(*arguments)

    return alone


@functools.cache
def forget_stale_code(folder: Path) -> None:
    """Delete cached machine code below `folder` that is older than a source file there, once per process.

    Call this before the first kernel: numba compares the cache with the kernel's own file, not with its callees'.
    """
    newest = max(source.stat().st_mtime for source in folder.rglob("*.py"))
    for index in folder.rglob("__pycache__/*.nbi"):
        with contextlib.suppress(OSError):  # another process deleted it first, or the installation is read-only
            if index.stat().st_mtime < newest:
                index.unlink()
