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

    counted()  # compiles and allocates
    flops, peak = observed(counted, context.device)
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        predictions_of([row], many, context)
        seconds.append(time.perf_counter() - start)
    return Cost(
        ms_per_window=1000 * statistics.median(seconds) / len(many.dolp),
        gflop=flops / len(few.dolp) / 1e9 if network is not None else None,
        params=sum(p.numel() for p in network.parameters()) if network is not None else 0,
        peak_mib=peak / MIB,
    )


def first_windows(sequence: TestSequence, count: int) -> TestSequence:
    """The first `count` windows of a sequence; all of it if it is shorter. Later events belong to no window."""
    frames = {name: getattr(sequence, name)[:count] for name in ("dolp", "aolp", "s0")}
    valid = None if sequence.valid is None else sequence.valid[:count]
    return replace(sequence, t_us=sequence.t_us[: count + 1], valid=valid, **frames)


def observed(run: Callable[[], Any], device: torch.device) -> tuple[int, float]:
    """FLOPs of a run, and the most bytes that its tensors and arrays hold at once."""
    cuda = device.type == "cuda"
    before = 0
    if cuda:
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
    tracemalloc.start()  # numpy reports its arrays to tracemalloc
    try:
        with _Observed() as operations:
            run()
        arrays = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    peak = torch.cuda.max_memory_allocated(device) - before if cuda else arrays + operations.highest
    return operations.flops, float(peak)


class _Observed(TorchDispatchMode):
    """Adds up FLOPs of operations, and tracks the bytes of live tensors that they return, without kernels' scratch."""

    def __init__(self) -> None:
        super().__init__()
        self.flops = self.held = self.highest = 0
        self._known = weakref.WeakSet[torch.UntypedStorage]()

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # else torch imports its compiler (1.5 s) to exclude the mode from it

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation; count its FLOPs, if it has a formula, and the storage of its result, unless known."""
        self._known.update(_storages((args, kwargs)))  # weights and events existed before
        out = operation(*args, **(kwargs or {}))
        if (formula := FLOPS.get(operation.overloadpacket)) is not None:
            self.flops += formula(*args, **(kwargs or {}), out_val=out)
        for storage in _storages(out):
            if storage not in self._known:
                self._known.add(storage)
                self.held += storage.nbytes()
                weakref.finalize(storage, self._freed, storage.nbytes())
        self.highest = max(self.highest, self.held)
        return out

    def _freed(self, count: int) -> None:
        self.held -= count


def _storages(values: Any) -> list[torch.UntypedStorage]:
    return [tensor.untyped_storage() for tensor in tree_leaves(values) if isinstance(tensor, torch.Tensor)]
