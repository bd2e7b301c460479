"""The tasks of trainings: their start, their record, their losses, and masks."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from test_loop import LOOP, LOSS, NETWORK, SEED, TRAIN, run

from polarnet.config.tree import load
from polarnet.metrics.lpips import Lpips
from polarnet.metrics.similarity import ssim
from polarnet.networks.base.checkpoint import load_checkpoint, save_checkpoint
from polarnet.networks.e2p.network import coded_aolp
from polarnet.runtime.files import sha256
from polarnet.storage.events import EventStore
from polarnet.training.baselines import BASELINES
from polarnet.training.dolp import dolp_task
from polarnet.training.e2p import E2pConfig, e2p_task
from polarnet.training.engine.sequences import stack
from polarnet.training.engine.task import Split, Task, describe, open_split
from stages import train


def dolp() -> Task:
    return dolp_task("paper", NETWORK, TRAIN, LOSS, None, SEED)


def split_of(simulated, task: Task) -> Split:
    return open_split(EventStore.open(simulated.events), str(simulated.frames), task.encode)


def test_a_training_starts_from_the_weights_of_a_checkpoint_of_the_same_size_and_names_them(tmp_path):
    for name, network in (("other", NETWORK), ("wider", dataclasses.replace(NETWORK, channels=[8, 8, 8]))):
        weights = dolp_task("paper", network, TRAIN, LOSS, None, seed=SEED + 1).network.state_dict()
        save_checkpoint(tmp_path / f"{name}.safetensors", weights, {"network": "paper", "config": {}})
    start, wider = (str(tmp_path / f"{name}.safetensors") for name in ("other", "wider"))
    task = dolp_task("paper", NETWORK, dataclasses.replace(TRAIN, start=start), LOSS, None, SEED)
    tensors, known = load_checkpoint(start)
    assert all(torch.equal(tensor, tensors[name]) for name, tensor in task.network.state_dict().items())
    assert task.description["start_sha256"] == known["sha256"]
    assert "start_sha256" not in dolp().description
    with pytest.raises(ValueError, match="does not fit the network"):
        dolp_task("paper", NETWORK, dataclasses.replace(TRAIN, start=wider), LOSS, None, SEED)


def test_a_checkpoint_tells_what_decided_its_weights_without_a_path_of_this_machine(simulated, tmp_path):
    start = str(tmp_path / "start.safetensors")
    save_checkpoint(Path(start), dolp().network.state_dict(), {"network": "paper", "config": {}})
    config, loss = dataclasses.replace(TRAIN, start=start), dataclasses.replace(LOSS, half_weight=0.05)
    task = dolp_task("paper", NETWORK, config, loss, None, SEED)
    described = describe(task, split_of(simulated, task), config, "alex", SEED, torch.device("cpu"))
    assert described["half_weight"] == 0.05
    assert described["data"]["events_from"]["emulate"] == dataclasses.asdict(simulated.camera.sensor)
    assert described["data"]["events_sha256"] == sha256(simulated.events / "zarr.json")
    assert described["start_sha256"] == load_checkpoint(start)[1]["sha256"]
    assert str(tmp_path) not in json.dumps(described["training"])


E2P = E2pConfig(
    **LOOP | {"visits": 1, "windows": 3, "epochs": 1}, bins=5, intensity_lpips=0.0, lpips=0.0, mse=50.0, ssim=1.0
)


def test_a_training_of_e2p_has_the_published_size_and_the_truth_s0_coded_angle_and_dolp(stores, tmp_path):
    task = e2p_task(E2P, None, SEED)
    tensors, metadata = load_checkpoint(run(task, stores, tmp_path, E2P) / "best.safetensors")
    assert metadata["network"] == "e2p"
    assert sum(tensor.numel() for tensor in tensors.values()) == 512_501
    assert metadata["loss"] == {"aolp_mse": 50.0, "aolp_ssim_loss": 1.0, "dolp_mse": 50.0, "dolp_ssim_loss": 1.0}
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
    predicted, truth = torch.rand(2, 1, 2, 3, 32, 32).unbind()
    a, b = predicted[0], truth[0]
    distance = [lpips(a[:, i], b[:, i]).mean() for i in range(3)]
    polarization = [
        distance[i] + 50 * (a[:, i] - b[:, i]).square().mean() + (1 - ssim(a[:, i], b[:, i])).mean() for i in (1, 2)
    ]
    expected = 3 * distance[0] + sum(polarization)
    torch.testing.assert_close(loss.total(loss(predicted, truth)), expected, atol=1e-4, rtol=1e-4)


ROOT = Path(__file__).resolve().parents[2]


def test_lpips_is_on_the_device_of_the_training_and_is_not_loaded_for_a_loss_without_it(monkeypatch):
    for baseline in BASELINES.values():
        assert set(baseline.lpips) <= set(baseline.config.__dataclass_fields__)
    gives_lpips = dataclasses.replace(BASELINES["e2v"], task=lambda settings, lpips, seed: lpips)
    monkeypatch.setattr("polarnet.training.e2v.BASELINE", gives_lpips)
    monkeypatch.setattr(Lpips, "load", Lpips)
    _, lpips = train._task(load(ROOT, ["baseline=e2v"]), torch.device("meta"))
    assert {tensor.device.type for tensor in lpips.parameters()} == {"meta"}
    assert train._task(load(ROOT, ["baseline=e2v", "baselines.e2v.lpips=0"]), torch.device("meta"))[1] is None
