"""Device, determinism and named random generators."""

import ctypes
import hashlib
import multiprocessing
import os
import platform
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, TypeVar

import numba
import numpy as np
import torch
from pydantic import Field

from polarnet.runtime.sections import section

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h
MAX_KEPT = 2**30  # bytes
PR_SET_PDEATHSIG = 1  # prctl.h
MAX_MIXED = 2**20  # bytes; larger tensors get separate memory while long-lived ones are allocated

Item = TypeVar("Item")
Result = TypeVar("Result")


@section
class RuntimeConfig:
    """Section `runtime` of conf/config.yaml: settings that change no result."""

    device: str
    """auto (CUDA where there is one), cpu, cuda or cuda:N."""
    threads: Annotated[int, Field(ge=0, le=4096)]
    """Threads of torch and numba in each process; 0: one per core."""
    workers: Annotated[int, Field(gt=0, le=4096)]
    """Number of processes that share the sequences."""
    devices: Annotated[int, Field(gt=0, le=4096)]
    """Number of processes on this machine that share a training, each on its own GPU, or all on the processor."""


def seed_for(seed: int, name: str, purpose: str) -> int:
    """A 64-bit seed for one purpose of one named item, independent of order, worker and machine."""
    digest = hashlib.blake2b(f"{seed}\0{name}\0{purpose}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little")


def generator_for(seed: int, name: str, purpose: str) -> np.random.Generator:
    """A counter-based generator seeded by `seed_for`."""
    return np.random.Generator(np.random.Philox(seed_for(seed, name, purpose)))


def usable_cores() -> int:
    """Number of cores that this process may run on."""
    return len(os.sched_getaffinity(0))


def memory() -> tuple[int, int]:
    """Free and total memory of this machine in bytes."""
    lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    free, total = (1024 * int(lines[key].split()[0]) for key in ("MemAvailable", "MemTotal"))
    return free, total


def limit_threads(threads: int) -> None:
    """Let torch and numba use `threads` threads in this process."""
    torch.set_num_threads(threads)
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread, so that its bytes do not depend on the number of threads.

    torch computes the last values of each thread's part one by one, and rounds them differently from whole vectors.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def on_one_thread(function: Callable[[Item], Result], item: Item) -> Result:
    """`function(item)` in `one_thread`: a result that does not depend on the number of workers."""
    with one_thread():
        return function(item)


def threads_of(config: RuntimeConfig) -> int:
    """Threads per worker, so that all workers together use the cores of the machine."""
    return config.threads or max(1, usable_cores() // config.workers)


def processes_here() -> int:
    """Number of processes on this machine that share this training (polarnet.training.engine.parallel)."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


def device_of(config: RuntimeConfig) -> torch.device:
    """The torch device that `config.device` names; ValueError if it asks for a GPU and there is none."""
    own_gpu = f"cuda:{os.environ.get('LOCAL_RANK', 0)}"  # torchrun's number of this process
    if config.device == "auto":
        return torch.device(own_gpu if torch.cuda.is_available() else "cpu")
    device = torch.device(own_gpu if config.device == "cuda" else config.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"runtime.device={config.device}: torch {torch.__version__} sees no GPU; use device=cpu")
    return device


def bf16_units(device: torch.device) -> list[str]:
    """Units of this device that compute in bfloat16; empty where torch would only emulate it, slower than float32."""
    if device.type == "cuda":
        return ["CUDA"] if torch.cuda.is_bf16_supported(including_emulation=False) else []
    if device.type != "cpu" or not torch.backends.mkldnn.is_available():
        return []
    units = {"AMX": torch.cpu._is_amx_tile_supported(), "AVX512-BF16": torch.cpu._is_avx512_bf16_supported()}
    return [name for name, there in units.items() if there]


def precision_on(device: torch.device, precision: str) -> str:
    """fp32 or bf16: `precision`, or for auto, bf16 if the device has units for it."""
    return precision if precision != "auto" else "bf16" if bf16_units(device) else "fp32"


def end_with_parent(parent: int | None = None) -> None:
    """Let the system kill this process when the one that started it ends, however that ends.

    That one may have ended already: `parent` is its process number; None: multiprocessing knows it.
    """
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    starter = multiprocessing.parent_process()
    lives = os.getppid() == parent if parent is not None else starter is None or starter.is_alive()
    if not lives:
        os.kill(os.getpid(), signal.SIGKILL)


def keep_freed_memory() -> None:
    """Let glibc keep the memory of freed large tensors for reuse; no effect on other systems.

    By default glibc returns each to the system, and new memory comes page by page, zeroed.
    """
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_THRESHOLD, MAX_KEPT)
        libc.mallopt(M_TRIM_THRESHOLD, MAX_KEPT)


@contextmanager
def memory_handed_back() -> Iterator[None]:
    """Make glibc return the memory of large tensors at once; on leaving, keep it again (`keep_freed_memory`).

    Use it while allocating many long-lived tensors, which would otherwise leave unusable holes in memory.
    """
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, MAX_MIXED)
    try:
        yield
    finally:
        keep_freed_memory()


def tune() -> None:
    """Apply the settings that only add speed, in programs other than stages; `configure` calls it for stages."""
    torch.set_flush_denormal(True)  # processors compute slowly with denormal numbers; threads inherit the setting
    keep_freed_memory()


def configure(config: RuntimeConfig, seed: int) -> torch.device:
    """Set threads, seed torch, keep freed memory and request deterministic kernels; returns the device to run on."""
    limit_threads(config.threads or max(1, usable_cores() // processes_here()))
    tune()
    torch.manual_seed(seed)
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.set_deterministic_debug_mode("warn")  # use_deterministic_algorithms imports the compiler: one second
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]  # a debugging aid
    return device_of(config)
