"""Both ways to feed a training give the same numbers."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import test_loop
import torch
from test_loop import LOSS, NETWORK

from polarnet.networks.base.checkpoint import load_checkpoint, save_checkpoint
from polarnet.storage.frames import Contents, FrameStore
from polarnet.training.dolp import dolp_task
from polarnet.training.e2v import e2v_task
from polarnet.training.engine.loop import train_batch, validate
from polarnet.training.engine.sequences import Visits, batches_of
from polarnet.training.engine.task import Split, Task, describe, open_events, open_split

SEED = 5
CHANGES = {"visits": 1, "epochs": 1, "bptt_windows": 2, "schedule": "constant", "warmup": 0.0}
TRAIN = dataclasses.replace(test_loop.TRAIN, **CHANGES)
E2V = dataclasses.replace(test_loop.E2V, **CHANGES, bins=3)


def dolp() -> Task:
    return dolp_task("paper", NETWORK, TRAIN, LOSS, None, SEED)


def e2v() -> Task:
    return e2v_task(E2V, None, SEED)


def split_of(simulated, data: str, task: Task) -> Split:
    events = open_events(
        data, str(simulated.events), str(simulated.scenes), simulated.camera, simulated.seed, threads=1
    )
    return open_split(events, str(simulated.frames), task.encode)


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


@pytest.mark.parametrize(("new_task", "config"), [(dolp, TRAIN), (e2v, E2V)])
def test_two_steps_on_the_fly_are_two_steps_from_the_store_to_the_last_bit(simulated, new_task, config):
    weights, inputs = [], []
    for data in ("store", "fly"):
        task = new_task()
        visits = Visits(split_of(simulated, data, task).train, config, SEED, epoch=0)
        batch = next(batches_of(visits, [2, 0], config.batch_size, workers=int(data == "fly")))
        optimizer = torch.optim.Adam(task.network.parameters(), lr=config.learning_rate)
        assert len(train_batch(task, optimizer, batch, config, torch.device("cpu"))) == 2
        weights.append(task.network.state_dict())
        inputs.append(batch)
    assert inputs[0].names == inputs[1].names
    assert inputs[0].inputs.abs().sum() > 0
    assert all(torch.equal(a, b) for a, b in zip(inputs[0][1:5], inputs[1][1:5], strict=True))
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    assert any(not torch.equal(weights[0][name], tensor) for name, tensor in new_task().network.state_dict().items())


def test_no_event_file_is_needed_on_the_fly(simulated, tmp_path):
    for path in (simulated.scenes, simulated.frames):
        shutil.copytree(path, tmp_path / path.name)
    moved = simulated._replace(
        scenes=tmp_path / "scenes.zarr", frames=tmp_path / "frames.zarr", events=tmp_path / "events.zarr"
    )
    assert len(split_of(moved, "fly", dolp()).train[0].inputs) == 6
    with pytest.raises(FileNotFoundError):
        split_of(moved, "store", dolp())


def test_a_checkpoint_tells_what_decided_its_weights_without_a_path_of_this_machine(simulated, tmp_path):
    start = str(tmp_path / "start.safetensors")
    save_checkpoint(Path(start), dolp().network.state_dict(), {"network": "paper"})
    described = []
    for data, half_weight in (("store", 0.05), ("fly", 0.1)):
        config = dataclasses.replace(TRAIN, start=start, data=data)
        loss = dataclasses.replace(LOSS, half_weight=half_weight)
        task = dolp_task("paper", NETWORK, config, loss, None, SEED)
        split = split_of(simulated, data, task)
        described.append(describe(task, split, config, tmp_path, SEED, torch.device("cpu")))
        assert described[-1]["training"]["data"] == data
        assert described[-1]["half_weight"] == half_weight
        assert described[-1]["data"]["events_from"]["emulate"] == dataclasses.asdict(simulated.camera.sensor)
    store, fly = (one["data"]["events_sha256"] for one in described)
    assert store != fly
    assert described[0]["start_sha256"] == load_checkpoint(start)[1]["sha256"]
    assert str(tmp_path) not in json.dumps(described[0]["training"])


@pytest.fixture
def masked(simulated, tmp_path):
    """The simulated sequences with the left third of all frames masked, and all of the first three frames."""
    source = FrameStore.open(simulated.frames)
    frames = FrameStore.create(
        tmp_path / "masked.zarr", Contents(source.splits, masked=True), 7, source.height, source.width
    )
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
    split = split_of(masked, "store", task)
    (val,) = split.val
    assert val.valid.shape == val.dolp.shape
    assert val.valid.float().mean() == pytest.approx(4 / 6 * 2 / 3)
    with torch.no_grad():
        predicted, _ = task.unroll(val.inputs[:, None], None)
    expected = (predicted[2:, 0, 0, :, 8:] - val.dolp[2:, :, 8:]).square().mean().item()
    config = dataclasses.replace(TRAIN, bptt_windows=6)
    assert validate(task, split.val, config, cpu, workers=0)["mse"] == pytest.approx(expected, rel=1e-4)
    plain = validate(task, split_of(simulated, "store", task).val, config, cpu, workers=0)["mse"]
    assert plain != pytest.approx(expected, rel=1e-3)
    batch = next(batches_of(split.train, [0, 1], 2, workers=0))
    valid = e2v().streams(batch._replace(inputs=torch.zeros(6, 2, 12, 18, 24)))[2]
    assert torch.equal(valid, torch.stack([batch.valid[:, k // 4] for k in range(8)], dim=1))  # four channels of each
