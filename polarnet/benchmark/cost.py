"""Cost of a method on this machine: time, arithmetic and memory of a window, and number of parameters."""

import statistics
import time
import tracemalloc
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry, sdpa_flop, shape_wrapper

from polarnet.benchmark.rows import Context, opened, predictions_of
from polarnet.benchmark.score import Cost
from polarnet.benchmark.sequences import TestSequence
from polarnet.methods import METHODS

COUNTED_WINDOWS = 3  # windows to count arithmetic and memory over: enough for the state to be passed on
TIMED_WINDOWS = 6
REPEATS = 3  # number of timings; the median is reported
MIB = 2**20

# Formulas of torch's own counter (2.13), and that of fused attention on CPUs, which it omits.
FLOPS = flop_registry | {
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: shape_wrapper(
        lambda q, k, v, *_, out_shape=None, **__: sdpa_flop(q, k, v)
    )
}


def cost_of(row: str, sequence: TestSequence, context: Context) -> Cost:
    """Measure a row on the first windows of a sequence, several times; the first call is not timed."""
    network = opened(METHODS[row], context).network if row in METHODS else None

    few, many = first_windows(sequence, COUNTED_WINDOWS), first_windows(sequence, TIMED_WINDOWS)

    def counted() -> Any:
        return predictions_of([row], few, context)

    def timed() -> Any:
        return predictions_of([row], many, context)

    counted()  # compiles and allocates
    with _Flops() as flops:
        peak = _peak_bytes(counted, context.device)
    return Cost(
        ms_per_window=1000 * statistics.median(_seconds(timed) for _ in range(REPEATS)) / len(many.dolp),
        gflop=flops.total / len(few.dolp) / 1e9 if network is not None else None,
        params=sum(p.numel() for p in network.parameters()) if network is not None else 0,
        peak_mib=peak / MIB,
    )


def first_windows(sequence: TestSequence, count: int) -> TestSequence:
    """The first `count` windows of a sequence; all of it if it is shorter. Later events belong to no window."""
    frames = {name: getattr(sequence, name)[:count] for name in ("dolp", "aolp", "s0")}
    valid = None if sequence.valid is None else sequence.valid[:count]
    return replace(sequence, t_us=sequence.t_us[: count + 1], valid=valid, **frames)


def _seconds(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def _peak_bytes(run: Callable[[], Any], device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        run()
        return float(torch.cuda.max_memory_allocated(device) - before)
    tracemalloc.start()  # numpy reports its arrays to tracemalloc
    try:
        with _TensorMemory() as tensors:
            run()
        arrays = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    return float(arrays + tensors.highest)


class _Observer(TorchDispatchMode):
    """A mode that sees every operation. By default torch imports its compiler (1.5 s) to exclude the mode from it."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False


class _Flops(_Observer):
    """Adds up the FLOPs of operations."""

    total = 0

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation and count it, if it has a formula."""
        out = operation(*args, **(kwargs or {}))
        if (formula := FLOPS.get(operation.overloadpacket)) is not None:
            self.total += formula(*args, **(kwargs or {}), out_val=out)
        return out


class _TensorMemory(_Observer):
    """Tracks the bytes of live tensors that operations return; scratch memory inside kernels is not counted."""

    def __init__(self) -> None:
        super().__init__()
        self.held = 0
        self.highest = 0
        self._known = weakref.WeakSet[torch.UntypedStorage]()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation and count the storage of its result, unless that is a view of a known storage."""
        for tensor in tree_leaves((args, kwargs)):
            if isinstance(tensor, torch.Tensor):
                self._known.add(tensor.untyped_storage())  # weights and events existed before
        out = operation(*args, **(kwargs or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, torch.Tensor):
                storage = tensor.untyped_storage()
                if storage not in self._known:
                    self._known.add(storage)
                    self.held += storage.nbytes()
                    weakref.finalize(storage, self._freed, storage.nbytes())
        self.highest = max(self.highest, self.held)
        return out

    def _freed(self, count: int) -> None:
        self.held -= count
