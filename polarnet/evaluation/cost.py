"""What a method costs: time, arithmetic, parameters and memory of a window, measured on the machine at hand."""

import statistics
import tracemalloc
import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import nn
from torch.nn.modules.module import register_module_forward_pre_hook
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop

from polarnet.evaluation.methods import Context, Recording, recover
from polarnet.events.stream import slice_time

COUNTED_WINDOWS = 3  # arithmetic and memory are counted over so many windows: enough for a state to be carried on
TIMED_WINDOWS = 10
REPEATS = 3  # timings, of which the median counts
MIB = 2**20

# The fused attention of CPUs, which torch's own counter (2.13) leaves out.
CPU_ATTENTION = {
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: lambda q, k, v, *_, out_shape=None, **__: sdpa_flop(
        q, k, v
    )
}


@dataclass(frozen=True)
class Cost:
    """Of one window of all four polarizers, and of the method."""

    ms_per_window: float
    """From events in memory to a DoLP frame in memory, the making of the input included."""
    gflop: float | None
    """Of convolutions, matrix products and attention, a multiply-add as two; None for a method without a network."""
    params: int
    """Of the networks that it runs."""
    peak_mib: float
    """The most memory that tensors and arrays held at once beside the recording, over `COUNTED_WINDOWS` windows."""


def cost_of(method: str, recording: Recording, context: Context) -> Cost:
    """Run `method` on the first windows of a recording, a few times over; the first call is not timed."""
    short = first_windows(recording, COUNTED_WINDOWS)
    windows = len(short.dolp)
    modules = _modules_called(lambda: recover(method, short, context))  # loads, compiles and allocates
    params = {id(p): p.numel() for module in modules for p in module.parameters()}
    with FlopCounterMode(display=False, custom_mapping=CPU_ATTENTION) as counter:
        recover(method, short, context)
    peak = _peak_bytes(lambda: recover(method, short, context), context.device)
    timed = first_windows(recording, TIMED_WINDOWS)
    seconds = [recover(method, timed, context).seconds for _ in range(REPEATS)]
    return Cost(
        ms_per_window=1000 * statistics.median(seconds) / len(timed.dolp),
        gflop=counter.get_total_flops() / windows / 1e9 if modules else None,
        params=sum(params.values()),
        peak_mib=peak / MIB,
    )


def first_windows(recording: Recording, count: int) -> Recording:
    """A recording cut after `count` windows, or all of it where it has no more."""
    t_us = recording.t_us[: count + 1]
    end_us = int(t_us[-1]) + 1
    return replace(
        recording,
        events=[slice_time(events, 0, end_us) for events in recording.events],
        t_us=t_us,
        dolp=recording.dolp[:count],
        aolp=recording.aolp[:count],
        s0=recording.s0[:count],
        valid=None if recording.valid is None else recording.valid[:count],
    )


def _modules_called(run: Callable[[], Any]) -> list[nn.Module]:
    """Every module whose forward `run` calls, once each."""
    found: dict[int, nn.Module] = {}

    def note(module: nn.Module, _: Any) -> None:
        found[id(module)] = module

    handle = register_module_forward_pre_hook(note)
    try:
        run()
    finally:
        handle.remove()
    return list(found.values())


def _peak_bytes(run: Callable[[], Any], device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        run()
        return float(torch.cuda.max_memory_allocated(device) - before)
    tracemalloc.start()  # numpy tells it of its arrays
    try:
        with _TensorMemory() as tensors:
            run()
        arrays = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    return float(arrays + tensors.highest)


class _TensorMemory(TorchDispatchMode):
    """Adds up the bytes of tensors that operations return, as long as they live; memory inside a kernel is not seen."""

    def __init__(self) -> None:
        super().__init__()
        self.held = 0
        self.highest = 0
        self._known = weakref.WeakSet[torch.UntypedStorage]()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation and note the storage of what it returns, unless that is a view of a known one."""
        for tensor in tree_leaves((args, kwargs)):
            if isinstance(tensor, torch.Tensor):
                self._known.add(tensor.untyped_storage())  # weights and recordings were there before
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
