"""Run polarnet's network on two threads, for runs of many windows.

The first half of the network (`StokesUNet.solve_windows`) does not depend on its recurrent layers. One thread therefore
solves the next windows while the other refines the present ones. On a small sensor, a window is many short operations,
which two threads share less well (docs/benchmark.md has windows a second).
"""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.events.streaming import EventWindow
from polarnet.methods.method import State, windows_at_once
from polarnet.networks.polarnet.stokes_unet import SOLVER_TENSORS, Solved, StokesUNet
from polarnet.runtime.machine import torch_threads
from polarnet.stokes import Prediction

PARTS = 8  # parts of a run, each as large as a run on one thread
AHEAD = 2  # parts that may be solved before they are refined


class Sharing(NamedTuple):
    """A network for inference, and how its runs of windows are shared between two threads."""

    network: StokesUNet
    encode: Callable[[Sequence[EventWindow]], Float[Tensor, "n 1 8 h w"]]
    autocast: Callable[[], torch.autocast]
    """Context manager that sets the precision of the thread that enters it."""
    solver: ThreadPoolExecutor
    """The other thread."""

    def part(self, height: int, width: int) -> int:
        """Number of windows of this size in a part of a run."""
        return windows_at_once(height // self.network.binning, width // self.network.binning)

    def at_once(self, height: int, width: int) -> int:
        """Number of windows of a run; one thread has nobody to share them with."""
        return (PARTS if torch.get_num_threads() > 1 else 1) * self.part(height, width)

    def parts(self, windows: Sequence[EventWindow]) -> list[Sequence[EventWindow]]:
        """Split a run of windows; on one thread, the run is a single part."""
        if torch.get_num_threads() == 1:
            return [windows]
        first = windows[0].channels[0]
        size = self.part(first.height, first.width)
        return [windows[k : k + size] for k in range(0, len(windows), size)]

    def predict(self, state: State, parts: Sequence[Sequence[EventWindow]]) -> tuple[State, Prediction]:
        """State and prediction after all windows of the `parts` of a run, as `Recoverer.predict`.

        Results are those of `StokesUNet.unroll` for each part. Each thread has half of torch's threads.
        """
        before = state or []
        solver, recurrent = before[:SOLVER_TENSORS], before[SOLVER_TENSORS:]
        half = torch.get_num_threads() // 2

        def solve(part: Sequence[EventWindow]) -> Solved:
            nonlocal solver
            torch.set_num_threads(half)
            with torch.no_grad(), self.autocast():
                solved, solver = self.network.solve_windows(self.encode(part), solver)
            return solved

        ahead: deque[Future[Solved]] = deque()
        predictions: list[Prediction] = []
        with torch_threads(half), torch.no_grad(), self.autocast():
            for number in range(len(parts) + AHEAD):
                if number < len(parts):
                    ahead.append(self.solver.submit(solve, parts[number]))
                if number >= AHEAD:
                    prediction, _, recurrent = self.network.refine_windows(ahead.popleft().result(), recurrent)
                    predictions.append(prediction)
        maps = (torch.cat(fields)[:, 0] for fields in zip(*predictions, strict=True) if fields[0] is not None)
        return [*solver, *recurrent], Prediction(*maps)
