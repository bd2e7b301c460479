"""Steps replayed as CUDA graphs against the same steps launched one by one; needs a GPU."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from polarnet.config.tree import load
from polarnet.training.dolp import dolp_task
from polarnet.training.engine.loop import autocast, train_batch
from polarnet.training.engine.optimizers import OPTIMIZERS
from polarnet.training.engine.replay import Replayed
from polarnet.training.engine.sequences import Batch

ROOT = Path(__file__).resolve().parents[2]
CONFIG = load(ROOT)
STEPS = 3  # batches; each has a run without a state and one that continues it


def batches() -> list[Batch]:
    """Batches of four windows of random events and truth."""
    generator = torch.Generator().manual_seed(2)

    def batch() -> Batch:
        count = torch.poisson(torch.full((4, 2, 4, 60, 80), 0.6), generator)
        polarity = count * (2 * torch.randint(0, 2, count.shape, generator=generator) - 1)
        inputs = torch.stack([polarity, count], dim=3).flatten(2, 3)
        dolp, angle = torch.rand(2, 4, 2, 60, 80, generator=generator)
        return Batch(["a", "b"], inputs, dolp, math.pi * angle, torch.zeros(0, 2, 4, 60, 80))

    return [batch() for _ in range(STEPS)]


def losses(device: torch.device, replayed: bool) -> list[float]:
    """The loss of each step of a training of a few batches."""
    loss = dataclasses.replace(CONFIG.loss, lpips=0.0)
    task = dolp_task("polarnet", CONFIG.networks.polarnet, CONFIG.train, loss, None, 1)
    section = dataclasses.replace(CONFIG.train, bptt_windows=2, precision="fp32")
    task.network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = OPTIMIZERS[task.optimizer](task.network, 1e-3)
    if replayed:
        task = dataclasses.replace(task, unroll=Replayed(task, autocast("fp32", device, cache_enabled=False)))
    steps = [train_batch(task, optimizer, batch, section, device) for batch in batches()]
    return [step["total"] for of_batch in steps for step in of_batch]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU: CUDA graphs cannot be recorded")
def test_a_replayed_training_has_the_losses_of_one_launched_operation_by_operation():
    device = torch.device("cuda")
    expected = losses(device, replayed=False)
    assert losses(device, replayed=True) == pytest.approx(expected, rel=1e-3)
    assert losses(torch.device("cpu"), replayed=False) == pytest.approx(expected, rel=1e-2)
