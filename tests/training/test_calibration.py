import dataclasses
import json
from typing import Any

import pytest
import torch
from test_loop import CPU, LOOP, SEED, Killed, bytes_of, run

from polarnet.config import load
from polarnet.events.store import EventStore
from polarnet.networks.checkpoint import load_network
from polarnet.training.calibration import Calibration, fitted
from polarnet.training.dolp import dolp_task
from polarnet.training.loop import TrainConfig, calibrate
from polarnet.training.losses import LossConfig
from polarnet.training.task import Task, open_split

TRAIN = TrainConfig(**LOOP, representation=None, optimizer=None)
LOSS = LossConfig(mse=1.0, ssim=0.0, lpips=0.0, stokes=1.0, uncertainty=0.04)


@pytest.fixture(scope="module")
def task_of(project_root):
    """A new task of a small polarnet."""
    config = dataclasses.replace(load(project_root).networks.polarnet, channels=[4, 4, 4], reach=3, scales=[1, 0])
    return lambda: dolp_task("polarnet", config, TRAIN, LOSS, None, SEED)


def test_the_scale_of_errors_is_found_again_from_what_hardly_told_them_apart():
    generator = torch.Generator().manual_seed(0)
    true = torch.randn(100_000, generator=generator, dtype=torch.float64) - 4
    squared = true.exp() * torch.randn(100_000, generator=generator, dtype=torch.float64).square()
    found = fitted(-3.9 + 0.05 * true, squared)
    assert found.slope == pytest.approx(20, rel=0.03)
    assert found.offset == pytest.approx(3.9 * 20, rel=0.03)


def test_one_expectation_for_all_gets_the_level_alone_and_no_error_is_refused():
    squared = torch.tensor([0.01, 0.03], dtype=torch.float64)
    found = fitted(torch.full((2,), -4.0, dtype=torch.float64), squared)
    assert found.slope == 1
    assert torch.tensor(found.offset - 4).exp().item() == pytest.approx(0.02)
    with pytest.raises(ValueError, match="got 2 pixels without any"):
        fitted(squared, 0 * squared)


def test_after_it_nothing_is_left_to_calibrate_and_dolp_is_what_it_was(stores, task_of):
    task = task_of()
    torch.nn.init.normal_(task.network.add.weight, std=0.1, generator=torch.Generator().manual_seed(1))
    split = open_split(EventStore.open(stores[0]), str(stores[1]), task.encode)
    windows = split.val[0].inputs[:, None]
    with torch.no_grad():
        before = task.network.unroll(windows, None)[0]
        first = calibrate(task, split.val, TRAIN, CPU, 0)
        after = task.network.unroll(windows, None)[0]
        again = calibrate(task, split.val, TRAIN, CPU, 0)
    assert first.slope != pytest.approx(1, abs=0.1)
    assert (again.offset, again.slope) == (pytest.approx(0, abs=1e-3), pytest.approx(1, abs=1e-3))
    torch.testing.assert_close(after.log_variance, first.offset + first.slope * before.log_variance)
    for name in ("dolp", "aolp", "stokes"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name))


def test_a_training_ends_with_it_even_if_killed_in_its_midst(stores, tmp_path, task_of):
    calls = 0

    def counting(task: Task, at: int) -> Task:
        def unroll(*arguments: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == at:
                raise Killed
            return task.unroll(*arguments)

        return dataclasses.replace(task, unroll=unroll)

    whole = bytes_of(run(counting(task_of(), 0), stores, tmp_path / "whole", TRAIN))
    last, calls = calls, 0
    with pytest.raises(Killed):
        run(counting(task_of(), last), stores, tmp_path / "killed", TRAIN)
    assert bytes_of(run(task_of(), stores, tmp_path / "killed", TRAIN)) == whole
    said = Calibration(**json.loads(whole["best.json"])["expected_errors"])
    assert said.slope != 1
    _, metadata = load_network(tmp_path / "whole" / "out" / "best.safetensors")
    assert metadata["expected_errors"] == said._asdict()
    assert "expected_errors" not in json.loads(whole["last.json"])
