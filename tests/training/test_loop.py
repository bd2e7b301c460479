"""The loop at a size where a whole training takes a second: CPU, fp32."""

from pathlib import Path
from typing import Any

import torch

from polarnet.networks.dolp_unet import DolpUNetConfig
from polarnet.training.dolp import dolp_task
from polarnet.training.e2v import E2vConfig, e2v_task
from polarnet.training.loop import TrainConfig, train
from polarnet.training.losses import LossConfig
from polarnet.training.recorder import Recorder
from polarnet.training.task import Task, describe, open_split

SEED = 7
CPU = torch.device("cpu")
LOOP: dict[str, Any] = {
    "epochs": 2,
    "batch_size": 2,
    "bptt_windows": 3,
    "learning_rate": 1e-3,
    "schedule": "cosine",
    "warmup": 0.1,
    "gradient_norm": 1.0,
    "precision": "fp32",
    "crop": [16, 20],
    "symmetries": True,
}
TRAIN = TrainConfig(**LOOP, representation="event_tensor")
E2V = E2vConfig(**LOOP, arch="firenet", bins=5, ssim=1.0, lpips=0.0)
NETWORK = DolpUNetConfig(channels=[4, 8, 8], swin_depth=2, swin_window=4, swin_heads=[1, 2], residual_blocks=1)
LOSS = LossConfig(mse=1.0, ssim=1.0, lpips=0.0)


class Killed(Exception):
    """Stands for the signal that ends a process."""


def small_task() -> Task:
    return dolp_task("paper", NETWORK, TRAIN, LOSS, None, SEED)


def run(task: Task, stores: tuple[Path, Path], folder: Path, config: TrainConfig | E2vConfig = TRAIN) -> Path:
    """A whole training that keeps a running checkpoint after every batch; the folder of its outputs."""
    split = open_split(str(stores[0]), str(stores[1]), task.encode)
    metadata = describe(task, split, config, folder, SEED)
    recorder = Recorder(folder / "out", folder / "resume", metadata, keep_every_s=0.0)
    train(task, split, config, recorder, SEED, CPU, workers=0)
    return folder / "out"


def test_a(stores, tmp_path):
    out = run(small_task(), stores, tmp_path)
    print(*out.rglob("*"), (out/"best.json").read_text(), (out/"history.json").read_text())
    out = run(e2v_task(E2V, None, SEED), stores, tmp_path/"e", E2V)
