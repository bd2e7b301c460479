"""data/events.zarr, data/frames.zarr -> data/train_e2v: the events-to-intensity baseline, on the same sequences."""

from pathlib import Path

from polarnet.config import Config, hydra_stage
from polarnet.runtime import device_of
from polarnet.training.e2v import e2v_task
from polarnet.training.loop import train
from polarnet.training.recorder import Recorder
from polarnet.training.task import describe, lpips_of, open_split


@hydra_stage
def main(config: Config) -> None:
    """Train FireNet on the training split; a killed run of the same training goes on where it stopped."""
    e2v = config.baselines.e2v
    lpips = lpips_of(Path(config.paths.weights), e2v.lpips)
    task = e2v_task(e2v, lpips, config.seed)
    split = open_split(config.paths.events, config.paths.frames, task.encode)
    metadata = describe(task, split, e2v, Path(config.paths.weights), config.seed)
    recorder = Recorder(Path(config.paths.train_e2v), Path(config.paths.resume), metadata)
    train(task, split, e2v, recorder, config.seed, device_of(config.runtime), config.runtime.workers)


if __name__ == "__main__":
    main()
