"""Several processes that share a training, each with a part of every batch: started by torchrun, or by `launched`.

They do what one process does with the same batches: gradients are summed before each step, up to rounding. Without
torchrun's environment there is one process, and nothing here does anything.
"""

import os
import subprocess
import sys

import torch
import torch.distributed as dist
from torch import Tensor

from polarnet.runtime import RuntimeConfig


def launched(module: str, runtime: RuntimeConfig) -> bool:
    """Start `python -m module` with this command line in `runtime.devices` processes and wait for them.

    False, and nothing done, where one process is enough or this is already one of several. A RuntimeError where
    one of them fails.
    """
    if "WORLD_SIZE" in os.environ or runtime.devices * runtime.nodes == 1:
        return False
    meeting = ["--standalone"]
    if runtime.nodes > 1:
        meeting = ["--rdzv-backend=c10d", f"--rdzv-endpoint={runtime.rendezvous}"]
    torchrun = ["torch.distributed.run", f"--nnodes={runtime.nodes}", f"--nproc-per-node={runtime.devices}", *meeting]
    status = subprocess.run([sys.executable, "-m", *torchrun, "-m", module, *sys.argv[1:]]).returncode
    if status:
        raise RuntimeError(f"{module}: a process of {runtime.devices} on this machine failed; its message is above")
    return True


def join(device: torch.device) -> None:
    """Meet the other processes that torchrun has started, if it has."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")


def place() -> tuple[int, int]:
    """This process's number and how many there are; number 0 writes what a training leaves behind."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


def add_up(tensors: list[Tensor]) -> None:
    """Put into each of these tensors, of one type and device, its sum over all processes."""
    if not dist.is_initialized():
        return
    flat = torch.cat([tensor.flatten() for tensor in tensors])
    dist.all_reduce(flat)
    for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(part.view_as(tensor))


def wait_for_all() -> None:
    """Return when every process has come here."""
    if dist.is_initialized():
        dist.barrier()
