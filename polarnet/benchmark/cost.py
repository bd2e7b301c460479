"""Cost of a method on this machine: time and arithmetic of a window, and number of parameters."""

import statistics
import time
from dataclasses import replace
from typing import Any

from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from polarnet.benchmark.rows import Context, opened, predictions_of
from polarnet.benchmark.score import Cost
from polarnet.benchmark.sequences import TestSequence
from polarnet.methods import METHODS

COUNTED_WINDOWS = 3  # windows to count arithmetic over: enough for the state to be passed on
TIMED_WINDOWS = 6
REPEATS = 3  # number of timings; the median is reported


def cost_of(row: str, sequence: TestSequence, context: Context) -> Cost:
    """Measure a row on the first windows of a sequence, several times; the first call is not timed."""
    recoverer = opened(METHODS[row], context) if row in METHODS else None
    network = recoverer.network if recoverer else None
    timed = recoverer.at_once(*sequence.dolp.shape[-2:]) if recoverer and recoverer.sees_ahead else TIMED_WINDOWS
    few, many = first_windows(sequence, COUNTED_WINDOWS), first_windows(sequence, timed)
    predictions_of([row], few, context)  # compiles and allocates
    with _Flops() as flops:
        predictions_of([row], few, context)
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        predictions_of([row], many, context)
        seconds.append(time.perf_counter() - start)
    return Cost(
        ms_per_window=1000 * statistics.median(seconds) / len(many.dolp),
        gflop=flops.total / len(few.dolp) / 1e9 if network is not None else None,
        params=sum(p.numel() for p in network.parameters()) if network is not None else 0,
    )


def first_windows(sequence: TestSequence, count: int) -> TestSequence:
    """The first `count` windows of a sequence; all of it if it is shorter. Later events belong to no window."""
    frames = {name: getattr(sequence, name)[:count] for name in ("dolp", "aolp", "s0")}
    valid = None if sequence.valid is None else sequence.valid[:count]
    return replace(sequence, t_us=sequence.t_us[: count + 1], valid=valid, **frames)


class _Flops(TorchDispatchMode):
    """Adds up the FLOPs of the operations that have a formula in torch's own counter."""

    def __init__(self) -> None:
        super().__init__()
        self.total = 0

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # else torch imports its compiler (1.5 s) to exclude the mode from it

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation and count its FLOPs."""
        out = operation(*args, **(kwargs or {}))
        if (formula := flop_registry.get(operation.overloadpacket)) is not None:
            self.total += formula(*args, **(kwargs or {}), out_val=out)
        return out
