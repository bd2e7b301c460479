"""Events (data/events.zarr or emulated from data/scenes.zarr), data/frames.zarr -> data/train_e2p: the E2P baseline."""

from pathlib import Path

from polarnet.config.tree import Config, hydra_stage, or_exit
from polarnet.runtime.machine import device_of, threads_of
from polarnet.training.baselines import is_used, leave_untrained
from polarnet.training.e2p import e2p_task
from polarnet.training.loop import train
from polarnet.training.parallel import join, launched
from polarnet.training.recorder import Recorder
from polarnet.training.task import describe, lpips_of, open_events, open_split


@hydra_stage
def main(config: Config) -> None:
    """Train E2P on the training split; a killed run of the same training resumes.

    If no method of `benchmark.methods` uses the weights, the stage says so and trains nothing.
    """
    if not is_used("e2p", config.benchmark.methods, config.methods):
        print(leave_untrained("e2p", Path(config.paths.train_e2p)))
        return
    if launched("stages.train_e2p", config.runtime):
        return
    device = device_of(config.runtime)
    join(device)
    e2p = config.baselines.e2p
    lpips = or_exit(lambda: lpips_of(config.paths.weights, config.lpips.backbone, max(e2p.lpips, e2p.intensity_lpips)))
    task = e2p_task(e2p, lpips, config.seed)
    paths, threads = config.paths, threads_of(config.runtime)
    events = open_events(e2p.data, paths.events, paths.scenes, config.emulate, config.seed, threads)
    split = open_split(events, paths.frames, task.encode)
    metadata = describe(task, split, e2p, Path(paths.weights), config.seed, device)
    recorder = Recorder(Path(paths.train_e2p), Path(paths.resume), metadata)
    train(task, split, e2p, recorder, config.seed, device, config.runtime.workers)


if __name__ == "__main__":
    main()
