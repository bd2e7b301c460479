"""Training steps on a GPU, recorded once as CUDA graphs and replayed.

A run of windows takes many small operations, forward and backward, which the processor launches one by one. A replay
launches all of them at once, with the same results.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from polarnet.training.engine.task import State, Task


class _Step(nn.Module):
    """`Task.unroll` as a module, whose parameters receive the gradients, with the state's tensors one by one."""

    def __init__(self, task: Task):
        super().__init__()
        self.network, self.unroll = task.network, task.unroll

    def forward(self, windows: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        predicted, after = self.unroll(windows, list(state) or None)
        return predicted, *(after or [])


class Replayed:
    """Same function as `task.unroll` on CUDA tensors, recorded at the first call for each shape of its arguments.

    The next call overwrites the prediction and the gradients. `unroll` must not wait for the GPU, and its operations
    may depend on the shapes of its arguments only.
    """

    def __init__(self, task: Task, autocast: torch.autocast):
        self._task, self._autocast = task, autocast
        self._recorded: dict[tuple[torch.Size, ...], Callable[..., Any]] = {}

    def __call__(self, windows: Tensor, state: State) -> tuple[Tensor, State]:
        """Return the predicted maps and the next state, as `task.unroll`."""
        arguments = (windows, *(state or []))
        shapes = tuple(argument.shape for argument in arguments)
        if shapes not in self._recorded:
            example = tuple(argument.clone() for argument in arguments)  # becomes the memory that replays read
            with self._autocast:
                step = torch.cuda.make_graphed_callables(_Step(self._task), example, allow_unused_input=True)
            self._recorded[shapes] = step
        predicted, *after = self._recorded[shapes](*arguments)
        return predicted, [tensor.clone() for tensor in after] or None
