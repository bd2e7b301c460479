"""Steps replayed as CUDA graphs against the same steps launched one by one; needs a GPU."""

import dataclasses
from pathlib import Path

import pytest
import torch

from polarnet.config.tree import load
from polarnet.training.baselines import BASELINES
from polarnet.training.dolp import dolp_task
from polarnet.training.loop import LoopConfig, autocast, train_batch
from polarnet.training.optimizers import OPTIMIZERS
from polarnet.training.replay import Replayed
from polarnet.training.sequences import Batch
from polarnet.training.task import Task

ROOT = Path(__file__).resolve().parents[2]
CONFIG = load(ROOT)
STEPS = 3  # batches; each has a run without a state and one that continues it


def task_of(name: str) -> tuple[Task, LoopConfig]:
    """A network with the settings of params.yaml, without LPIPS, and the section of its training."""
    if name in BASELINES:
        section = dataclasses.replace(getattr(CONFIG.baselines, name), **dict.fromkeys(BASELINES[name].lpips, 0.0))
        return BASELINES[name].task(section, None, 1), section
    loss = dataclasses.replace(CONFIG.loss, lpips=0.0)
    return dolp_task(name, getattr(CONFIG.networks, name), CONFIG.train, loss, None, 1), CONFIG.train


def batches(task: Task) -> list[Batch]:
    """Batches of four windows of random counts and truth."""
    generator = torch.Generator().manual_seed(2)
    channels = task.description["in_channels"] * (1 if task.description["in_channels"] % 4 == 0 else 4)
    shape = (4, 2, 60, 80)
    return [
        Batch(
            ["a", "b"],
            torch.randint(0, 3, (4, 2, channels, 60, 80), generator=generator),
            torch.rand(shape, generator=generator),
            torch.rand(shape, generator=generator) * 3,
            torch.rand(4, 2, 4, 60, 80, generator=generator),
        )
        for _ in range(STEPS)
    ]


def losses(name: str, device: torch.device, replayed: bool) -> list[float]:
    """The loss of each step of a training of a few batches."""
    task, section = task_of(name)
    section = dataclasses.replace(section, bptt_windows=2, precision="fp32")
    task.network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = OPTIMIZERS[task.optimizer](task.network, 1e-3)
    if replayed:
        task = dataclasses.replace(task, unroll=Replayed(task, autocast("fp32", device, cache_enabled=False)))
    steps = [train_batch(task, optimizer, batch, section, device) for batch in batches(task)]
    return [step["total"] for of_batch in steps for step in of_batch]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU: CUDA graphs cannot be recorded")
@pytest.mark.parametrize("name", ["polarnet", "paper", "e2v", "e2p"])
def test_a_replayed_training_has_the_losses_of_one_launched_operation_by_operation(name: str):
    device = torch.device("cuda")
    expected = losses(name, device, replayed=False)
    assert losses(name, device, replayed=True) == pytest.approx(expected, rel=1e-3)
    assert losses(name, torch.device("cpu"), replayed=False) == pytest.approx(expected, rel=1e-2)
