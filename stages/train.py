"""Events (data/events.zarr or emulated from data/scenes.zarr), data/frames.zarr -> data/train: the DoLP network."""

from pathlib import Path

from polarnet.config.tree import Config, hydra_stage, or_exit
from polarnet.runtime.machine import device_of, threads_of
from polarnet.training.dolp import dolp_task
from polarnet.training.loop import train
from polarnet.training.parallel import join, launched
from polarnet.training.recorder import Recorder
from polarnet.training.task import describe, lpips_of, open_events, open_split


@hydra_stage
def main(config: Config) -> None:
    """Train `network` on the training split; a killed run of the same training resumes."""
    if launched("stages.train", config.runtime):
        return
    device = device_of(config.runtime)
    join(device)
    lpips = or_exit(lambda: lpips_of(config.paths.weights, config.lpips.backbone, config.loss.lpips))
    task = dolp_task(config.network, config.network_config, config.train, config.loss, lpips, config.seed)
    paths, threads = config.paths, threads_of(config.runtime)
    events = open_events(config.train.data, paths.events, paths.scenes, config.emulate, config.seed, threads)
    split = open_split(events, paths.frames, task.encode)
    metadata = describe(task, split, config.train, Path(paths.weights), config.seed, device)
    recorder = Recorder(Path(paths.train), Path(paths.resume), metadata)
    train(task, split, config.train, recorder, config.seed, device, config.runtime.workers)


if __name__ == "__main__":
    main()
