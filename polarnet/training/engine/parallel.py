"""Data-parallel training: several processes share a training, and each takes a part of every batch.

torchrun or `launched` starts the processes. They sum their gradients before each step, so the result equals that of
one process with the same batches, up to rounding. With one process, `join`, `add_up` and `wait_for_all` do nothing.
"""

import functools
import os
import subprocess
import sys

import torch
import torch.distributed as dist
from torch import Tensor

from polarnet.runtime.machine import RuntimeConfig, end_with_parent


def launched(module: str, runtime: RuntimeConfig) -> bool:
    """Run `python -m module` with this command line in `runtime.devices` processes; RuntimeError if one fails.

    Returns False without starting anything if one process is enough or if torchrun started this process.
    """
    if "WORLD_SIZE" in os.environ or runtime.devices == 1:
        return False
    torchrun = ["torch.distributed.run", "--standalone", f"--nproc-per-node={runtime.devices}"]
    command = [sys.executable, "-m", *torchrun, "-m", module, *sys.argv[1:]]
    status = subprocess.run(command, preexec_fn=functools.partial(end_with_parent, os.getpid())).returncode
    if status:
        raise RuntimeError(f"{module}: a process of {runtime.devices} on this machine failed; its message is above")
    return True


def join(device: torch.device) -> None:
    """Join the process group if torchrun has started several processes; this one then ends with torchrun."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        end_with_parent()
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")


def place() -> tuple[int, int]:
    """Return this process's rank and the number of processes; rank 0 writes the outputs of the training."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


def add_up(tensors: list[Tensor]) -> None:
    """Replace each tensor by its sum over all processes; all tensors share one dtype and device."""
    if not dist.is_initialized():
        return
    flat = torch.cat([tensor.flatten() for tensor in tensors])
    dist.all_reduce(flat)
    for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(part.view_as(tensor))


def wait_for_all() -> None:
    """Wait until every process has reached this call."""
    if dist.is_initialized():
        dist.barrier()
