"""The loop at a size where a whole training takes a second: CPU, fp32."""

import dataclasses
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from part_fixtures import files_of

from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.networks.e2v.network import E2vid, FireNet
from polarnet.networks.paper.dolp_unet import DolpUNetConfig
from polarnet.networks.registry import load_network
from polarnet.runtime.files import SUMS
from polarnet.storage.events import EventStore
from polarnet.training.dolp import dolp_task
from polarnet.training.e2v import E2vConfig, e2v_task
from polarnet.training.engine.loop import LoopConfig, TrainConfig, set_learning_rate, train, validate
from polarnet.training.engine.losses import LossConfig
from polarnet.training.engine.recorder import Recorder, read_history, read_running
from polarnet.training.engine.sequences import stack
from polarnet.training.engine.task import Task, describe, open_split

SEED = 7
CPU = torch.device("cpu")
LOOP: dict[str, Any] = {
    "visits": 2,
    "windows": 4,
    "crop": [16, 20],
    "symmetries": True,
    "epochs": 2,
    "batch_size": 2,
    "bptt_windows": 3,
    "learning_rate": 1e-3,
    "schedule": "cosine",
    "warmup": 0.1,
    "gradient_norm": 1.0,
    "precision": "fp32",
}
TRAIN = TrainConfig(**LOOP, representation="event_tensor", optimizer=None, start=None, scene_dolp=None)
E2V = E2vConfig(**LOOP, arch="firenet", bins=5, ssim=1.0, lpips=0.0)
NETWORK = DolpUNetConfig(channels=[4, 8, 8], swin_depth=2, swin_window=4, swin_heads=[1, 2], residual_blocks=1)
LOSS = LossConfig(mse=1.0, ssim=1.0, lpips=0.0, stokes=0.0, half_weight=None)


class Killed(Exception):
    """Stands for the signal that ends a process."""


def small_task() -> Task:
    return dolp_task("paper", NETWORK, TRAIN, LOSS, None, SEED)


def run(task: Task, stores: tuple[Path, Path], folder: Path, config: LoopConfig = TRAIN, workers: int = 0) -> Path:
    """A whole training; the folder of its outputs."""
    split = open_split(EventStore.open(stores[0]), str(stores[1]), task.encode)
    metadata = describe(task, split, config, "alex", SEED, CPU)
    recorder = Recorder(folder / "out", folder / "resume", metadata)
    train(task, split, config, recorder, SEED, CPU, workers)
    return folder / "out"


def test_a_training_leaves_best_and_last_checkpoint_and_history(stores, tmp_path):
    out = run(small_task(), stores, tmp_path)
    files = files_of(out)
    assert files.keys() == {"best.safetensors", "best.json", "last.safetensors", "last.json", "history.csv", SUMS}
    history = read_history(out)
    assert [row["epoch"] for row in history] == [0, 1]
    _, metadata = load_network(out / "best.safetensors")
    assert metadata["val"]["mse"] == min(row["val"]["mse"] for row in history)
    assert metadata["training"]["learning_rate"] == TRAIN.learning_rate
    assert not list((tmp_path / "resume").iterdir())


def test_a_disk_without_room_for_the_checkpoints_is_refused_before_the_first_step(stores, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10_000))
    with pytest.raises(OSError, match=r"resume.+: the checkpoints need about \d\.\d MiB, the disk has 0\.0 MiB free"):
        run(small_task(), stores, tmp_path)
    assert not list((tmp_path / "resume").rglob("running.pt"))


def killed(task: Task, at: int, stores: tuple[Path, Path], folder: Path, config: LoopConfig = TRAIN) -> None:
    """A training that is killed when it is about to see windows for the `at`-th time."""
    calls = 0

    def unroll(*arguments: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == at:
            raise Killed
        return task.unroll(*arguments)

    with pytest.raises(Killed):
        run(dataclasses.replace(task, unroll=unroll), stores, folder, config)


@pytest.mark.thorough
@pytest.mark.parametrize("killed_at", [8, 9, 12])
def test_a_training_killed_at_any_step_ends_as_if_undisturbed(stores, tmp_path, undisturbed, killed_at):
    """Each of two epochs has eight steps, validation included."""
    killed(small_task(), killed_at, stores, tmp_path)
    assert files_of(run(small_task(), stores, tmp_path)) == undisturbed


def test_a_damaged_running_checkpoint_is_refused_wherever_the_damage_is(stores, tmp_path):
    killed(small_task(), 10, stores, tmp_path)
    (file,) = (tmp_path / "resume").rglob("running.pt")
    whole, content = file.read_bytes(), read_running(file)
    for place in range(1000, len(whole), len(whole) // 12):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
        try:
            read = torch.load(file, weights_only=True)
            torch.testing.assert_close(read, content, rtol=0, atol=0)  # padding, which no one reads
        except Exception:
            with pytest.raises(ValueError, match=r"running\.pt is damaged \(.+\); delete it to start the"):
                read_running(file)
    file.write_bytes(whole[:-100])
    with pytest.raises(ValueError, match=r"running\.pt is damaged"):
        run(small_task(), stores, tmp_path)


@pytest.fixture(scope="module")
def undisturbed(stores, tmp_path_factory) -> dict[str, bytes]:
    return files_of(run(small_task(), stores, tmp_path_factory.mktemp("undisturbed")))


def test_a_changed_setting_starts_anew(stores, tmp_path):
    task = small_task()
    split = open_split(EventStore.open(stores[0]), str(stores[1]), task.encode)
    places = {
        Recorder(tmp_path / "out", tmp_path / "resume", describe(task, split, config, "alex", SEED, CPU)).running
        for config in (TRAIN, dataclasses.replace(TRAIN, learning_rate=2e-3), dataclasses.replace(TRAIN, epochs=3))
    }
    assert len(places) == 3


def test_worker_processes_change_nothing(stores, tmp_path, undisturbed):
    assert files_of(run(small_task(), stores, tmp_path, workers=2)) == undisturbed


@pytest.mark.thorough
def test_one_sequence_can_be_learnt_by_heart(stores, tmp_path):
    config = dataclasses.replace(
        TRAIN, epochs=20, batch_size=1, bptt_windows=2, learning_rate=1e-2, windows=None, crop=None, symmetries=False
    )
    loss = LossConfig(mse=1.0, ssim=0.0, lpips=0.0, stokes=0.0, half_weight=None)
    task = dolp_task("paper", NETWORK, config, loss, None, SEED)
    split = open_split(EventStore.open(stores[0]), str(stores[1]), task.encode)
    split.train.sequences[1:] = []
    before = validate(task, split.train, config, CPU, workers=0)["mse"]
    recorder = Recorder(tmp_path / "out", tmp_path / "resume", {})
    train(task, split, config, recorder, SEED, CPU, workers=0)
    assert validate(task, split.train, config, CPU, workers=0)["mse"] < 0.2 * before


@pytest.mark.parametrize(
    ("arch", "network"), [("firenet", FireNet), pytest.param("e2vid", E2vid, marks=pytest.mark.thorough)]
)
def test_the_e2v_baseline_trains_in_the_same_loop(stores, tmp_path, arch, network):
    config = dataclasses.replace(E2V, arch=arch, epochs=1, visits=1, windows=2)
    tensors, metadata = load_checkpoint(
        run(e2v_task(config, None, SEED), stores, tmp_path, config) / "best.safetensors"
    )
    assert (metadata["network"], metadata["config"]) == (arch, {"bins": 5})
    network(**metadata["config"]).load_state_dict(tensors)
    assert tensors.get("pred.norm_layer.num_batches_tracked", 1) > 0


def test_the_e2v_baseline_learns_each_polarizers_intensity_from_its_own_events(stores):
    task = e2v_task(E2V, None, SEED)
    split = open_split(EventStore.open(stores[0]), str(stores[1]), task.encode)
    batch = stack([split.train[0], split.train[1]])
    voxels, intensity, valid = task.streams(batch)
    assert valid is None  # no pixel of these stores is masked
    assert voxels.shape == (6, 2 * 4, 5, 16, 24)
    assert torch.equal(voxels[:, 4 + 3], batch.inputs[:, 1, 15:20])  # second sequence, 135 degrees
    assert torch.equal(intensity[:, 4 + 3], batch.intensity[:, 1, 3])
    masked = batch._replace(valid=batch.dolp > 0.2)
    assert torch.equal(task.streams(masked)[2], masked.valid.repeat_interleave(4, dim=1))  # four channels of each


def test_automatic_precision_trains_in_bfloat16_where_there_are_units_and_names_it(stores, tmp_path, monkeypatch):
    monkeypatch.setattr("polarnet.runtime.machine.bf16_units", lambda device: ["AMX"])
    task = small_task()
    before = {name: tensor.clone() for name, tensor in task.network.state_dict().items()}
    out = run(task, stores, tmp_path, dataclasses.replace(TRAIN, epochs=1, visits=1, precision="auto"))
    after = task.network.state_dict()
    assert all(tensor.dtype == torch.float32 and tensor.isfinite().all() for tensor in after.values())
    assert any(not torch.equal(after[name], before[name]) for name in before)
    assert load_checkpoint(out / "last.safetensors")[1]["training"]["precision"] == "bf16"


def test_a_loss_that_is_not_a_number_stops_the_training(stores, tmp_path):
    task = small_task()
    broken = dataclasses.replace(task, unroll=lambda windows, state: (task.unroll(windows, state)[0] * math.nan, None))
    with pytest.raises(FloatingPointError, match=r"the loss is nan in epoch 1 .*lower learning_rate"):
        run(broken, stores, tmp_path)


def test_the_learning_rate_rises_and_then_falls_along_a_cosine():
    optimizer = torch.optim.Adam([torch.zeros(1, requires_grad=True)], lr=1.0)
    config = dataclasses.replace(TRAIN, learning_rate=1.0, warmup=0.25)
    for done, rise in ((0.0, 0.0), (0.125, 0.5), (0.25, 1.0), (0.5, 1.0), (1.0, 1.0)):
        set_learning_rate(optimizer, config, done)
        assert optimizer.param_groups[0]["lr"] == pytest.approx(rise * (1 + math.cos(math.pi * done)) / 2)
    set_learning_rate(optimizer, dataclasses.replace(config, schedule="constant", warmup=0.0), 0.0)
    assert optimizer.param_groups[0]["lr"] == 1.0
