"""data/events.zarr, data/frames.zarr -> data/train: the DoLP network."""

from pathlib import Path

from polarnet.config import Config, hydra_stage
from polarnet.runtime import device_of
from polarnet.training.dolp import dolp_task
from polarnet.training.loop import train
from polarnet.training.recorder import Recorder
from polarnet.training.task import describe, lpips_of, open_split


@hydra_stage
def main(config: Config) -> None:
    """Train `network` on the training split; a killed run of the same training goes on where it stopped."""
    lpips = lpips_of(Path(config.paths.weights), config.loss.lpips)
    task = dolp_task(config.network, config.network_config, config.train, config.loss, lpips, config.seed)
    split = open_split(config.paths.events, config.paths.frames, task.encode)
    metadata = describe(task, split, config.train, Path(config.paths.weights), config.seed)
    recorder = Recorder(Path(config.paths.train), Path(config.paths.resume), metadata)
    train(task, split, config.train, recorder, config.seed, device_of(config.runtime), config.runtime.workers)


if __name__ == "__main__":
    main()
