"""data/events.zarr, data/frames.zarr -> data/train/NAME: a trained network.

`python -m stages.train` trains the DoLP network `network` into data/train/ours; `python -m stages.train baseline=NAME`
trains a baseline, with the settings of section `baselines.NAME`.
"""

from importlib import import_module
from pathlib import Path

import torch

from polarnet.config.tree import DOLP_TRAINING, Config, hydra_stage
from polarnet.metrics.lpips import Lpips
from polarnet.runtime.machine import device_of
from polarnet.storage.events import EventStore
from polarnet.training.engine.loop import LoopConfig, train
from polarnet.training.engine.recorder import Recorder
from polarnet.training.engine.task import Task, describe, open_split


@hydra_stage
def main(config: Config) -> None:
    """Train one network on the training split; a killed run of the same training resumes."""
    device = device_of(config.runtime)
    settings, task = _task(config, device)
    paths = config.paths
    split = open_split(EventStore.open(paths.events), paths.frames, task.encode)
    metadata = describe(task, split, settings, config.lpips.backbone, config.seed, device)
    recorder = Recorder(Path(paths.train) / (config.baseline or DOLP_TRAINING), Path(paths.resume), metadata)
    train(task, split, settings, recorder, config.seed, device, config.runtime.workers)


def _task(config: Config, device: torch.device) -> tuple[LoopConfig, Task]:
    """Settings and task of the training, with LPIPS on its device; ValueError if LPIPS weights are missing."""

    def lpips(weight: float) -> Lpips | None:
        return Lpips.load(config.lpips.backbone).to(device) if weight > 0 else None

    tasks = import_module(f"polarnet.training.{config.baseline or 'dolp'}")
    if config.baseline is None:
        network, loss = config.network_config, config.loss
        return config.train, tasks.dolp_task(
            config.network, network, config.train, loss, lpips(loss.lpips), config.seed
        )
    settings = config.baseline_config(config.baseline)
    largest = max((getattr(settings, key) for key in tasks.BASELINE.lpips), default=0.0)
    return settings, tasks.BASELINE.task(settings, lpips(largest), config.seed)


if __name__ == "__main__":
    main()
