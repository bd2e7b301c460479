"""The tasks of trainings: their start, their record, and masks."""

import dataclasses
import json
from pathlib import Path

import pytest
import test_loop
import torch
from test_loop import LOSS, NETWORK

from polarnet.networks.base.checkpoint import load_checkpoint, save_checkpoint
from polarnet.runtime.files import sha256
from polarnet.storage.events import EventStore
from polarnet.storage.frames import Contents, FrameStore
from polarnet.training.dolp import dolp_task
from polarnet.training.e2v import e2v_task
from polarnet.training.engine.loop import validate
from polarnet.training.engine.sequences import batches_of
from polarnet.training.engine.task import Split, Task, describe, open_split

SEED = 5
CHANGES = {"visits": 1, "epochs": 1, "bptt_windows": 2, "schedule": "constant", "warmup": 0.0}
TRAIN = dataclasses.replace(test_loop.TRAIN, **CHANGES)
E2V = dataclasses.replace(test_loop.E2V, **CHANGES, bins=3)


def dolp() -> Task:
    return dolp_task("paper", NETWORK, TRAIN, LOSS, None, SEED)


def e2v() -> Task:
    return e2v_task(E2V, None, SEED)


def split_of(simulated, task: Task) -> Split:
    return open_split(EventStore.open(simulated.events), str(simulated.frames), task.encode)


def test_a_training_starts_from_the_weights_of_a_checkpoint_of_the_same_size_and_names_them(tmp_path):
    for name, network in (("other", NETWORK), ("wider", dataclasses.replace(NETWORK, channels=[8, 8, 8]))):
        weights = dolp_task("paper", network, TRAIN, LOSS, None, seed=SEED + 1).network.state_dict()
        save_checkpoint(tmp_path / f"{name}.safetensors", weights, {"network": "paper"})
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
    save_checkpoint(Path(start), dolp().network.state_dict(), {"network": "paper"})
    config, loss = dataclasses.replace(TRAIN, start=start), dataclasses.replace(LOSS, half_weight=0.05)
    task = dolp_task("paper", NETWORK, config, loss, None, SEED)
    described = describe(task, split_of(simulated, task), config, "alex", SEED, torch.device("cpu"))
    assert described["half_weight"] == 0.05
    assert described["data"]["events_from"]["emulate"] == dataclasses.asdict(simulated.camera.sensor)
    assert described["data"]["events_sha256"] == sha256(simulated.events / "zarr.json")
    assert described["start_sha256"] == load_checkpoint(start)[1]["sha256"]
    assert str(tmp_path) not in json.dumps(described["training"])


@pytest.fixture
def masked(simulated, tmp_path):
    """The simulated sequences with the left third of all frames masked, and all of the first three frames."""
    source = FrameStore.open(simulated.frames)
    contents = Contents(source.splits, masked=True)
    frames = FrameStore.create(tmp_path / "masked.zarr", contents, source.height, source.width)
    for name in source.sequences:
        truth = source.frames(name)
        valid = torch.ones_like(truth.dolp, dtype=torch.bool)
        valid[..., :8] = False
        valid[:3] = False
        frames.write(name, *truth[:4], valid)
    frames.finish()
    return simulated._replace(frames=tmp_path / "masked.zarr")


def test_training_and_validation_leave_masked_pixels_out(masked, simulated):
    task, cpu = dolp(), torch.device("cpu")
    split = split_of(masked, task)
    (val,) = split.val
    assert val.valid.shape == val.dolp.shape
    assert val.valid.float().mean() == pytest.approx(4 / 6 * 2 / 3)
    with torch.no_grad():
        predicted, _ = task.unroll(val.inputs[:, None], None)
    expected = (predicted[2:, 0, 0, :, 8:] - val.dolp[2:, :, 8:]).square().mean().item()
    config = dataclasses.replace(TRAIN, bptt_windows=6)
    assert validate(task, split.val, config, cpu, workers=0)["mse"] == pytest.approx(expected, rel=1e-4)
    plain = validate(task, split_of(simulated, task).val, config, cpu, workers=0)["mse"]
    assert plain != pytest.approx(expected, rel=1e-3)
    batch = next(batches_of(split.train, [0, 1], 2, workers=0))
    valid = e2v().streams(batch._replace(inputs=torch.zeros(6, 2, 12, 18, 24)))[2]
    assert torch.equal(valid, torch.stack([batch.valid[:, k // 4] for k in range(8)], dim=1))  # four channels of each
