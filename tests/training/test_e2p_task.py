"""E2P in the loop of every other network, at a size where a training takes seconds."""

import dataclasses

import torch
from test_loop import LOOP, SEED, run

from polarnet.metrics.lpips import Lpips
from polarnet.metrics.similarity import ssim
from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.networks.e2p.network import coded_aolp
from polarnet.storage.events import EventStore
from polarnet.training.e2p import BranchLoss, E2pConfig, e2p_task
from polarnet.training.engine.sequences import stack
from polarnet.training.engine.task import open_split

E2P = E2pConfig(
    **LOOP | {"visits": 1, "windows": 3, "epochs": 1}, bins=5, intensity_lpips=0.0, lpips=0.0, mse=50.0, ssim=1.0
)


def test_a_training_of_e2p_leaves_a_checkpoint_of_the_published_size(stores, tmp_path):
    task = e2p_task(E2P, None, SEED)
    tensors, metadata = load_checkpoint(run(task, stores, tmp_path, E2P) / "best.safetensors")
    assert metadata["network"] == "e2p"
    assert sum(tensor.numel() for tensor in tensors.values()) == 512_501
    assert metadata["loss"] == {"aolp_mse": 50.0, "aolp_ssim_loss": 1.0, "dolp_mse": 50.0, "dolp_ssim_loss": 1.0}


def test_the_truth_is_s0_the_coded_angle_and_dolp_and_dolp_is_scored(stores):
    task = e2p_task(E2P, None, SEED)
    split = open_split(EventStore.open(stores[0]), str(stores[1]), task.encode)
    batch = stack([split.train[0], split.train[1]])
    mosaic, truth, valid = task.streams(batch)
    assert valid is None  # no pixel of these stores is masked
    windows, _, _, height, width = batch.inputs.shape
    assert mosaic.shape == (windows, 2, 5, 2 * height, 2 * width)
    assert torch.equal(mosaic[:, :, :, 1::2, 1::2], batch.inputs[:, :, :5])  # 0 degrees
    assert torch.equal(truth[:, :, 0], batch.intensity[:, :, 0] + batch.intensity[:, :, 2])
    assert torch.equal(truth[:, :, 1], coded_aolp(batch.aolp))
    assert torch.equal(task.scored(truth), batch.dolp)


def test_the_loss_is_the_published_one():
    torch.manual_seed(0)
    lpips = Lpips("vgg")
    config = dataclasses.replace(E2P, intensity_lpips=3.0, lpips=1.0)
    loss = e2p_task(config, lpips, SEED).loss
    assert isinstance(loss, BranchLoss)
    predicted, truth = torch.rand(2, 1, 2, 3, 32, 32).unbind()
    a, b = predicted[0], truth[0]
    distance = [lpips(a[:, i], b[:, i]).mean() for i in range(3)]
    polarization = [
        distance[i] + 50 * (a[:, i] - b[:, i]).square().mean() + (1 - ssim(a[:, i], b[:, i])).mean() for i in (1, 2)
    ]
    expected = 3 * distance[0] + sum(polarization)
    torch.testing.assert_close(loss.total(loss(predicted, truth)), expected, atol=1e-4, rtol=1e-4)


def test_pixels_that_are_not_valid_cost_nothing():
    torch.manual_seed(0)
    loss, truth = e2p_task(E2P, None, SEED).loss, torch.rand(1, 2, 3, 16, 16)
    valid = torch.rand(1, 2, 16, 16) < 0.7
    spoilt = torch.where(valid[:, :, None], truth, 5.0)
    assert loss.total(loss(spoilt, truth, valid)).abs() < 1e-4
    assert loss.total(loss(spoilt, truth)) > 1
