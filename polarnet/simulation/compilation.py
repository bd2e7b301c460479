"""How the kernels of this folder are compiled: by numba, without the interpreter's lock, and kept on disk."""

import contextlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba


def compiled(kernel: Callable) -> Any:
    """A kernel as machine code."""
    return numba.njit(nogil=True, cache=True, error_model="numpy")(_bare(kernel))


def inlined(kernel: Callable) -> Any:
    """A small kernel that becomes part of those that call it."""
    return numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")(_bare(kernel))


def _bare(kernel: Callable) -> Callable:
    return inspect.unwrap(kernel)  # of the type checker that tests wrap around every function


def _forget_stale_code(folder: Path) -> None:
    """Delete machine code older than any source here: numba looks at a kernel's own file, not at its callees'."""
    newest = max(source.stat().st_mtime for source in folder.rglob("*.py"))
    for index in folder.rglob("__pycache__/*.nbi"):
        with contextlib.suppress(OSError):  # another process was quicker, or the installation is read-only
            if index.stat().st_mtime < newest:
                index.unlink()


_forget_stale_code(Path(__file__).parent)
