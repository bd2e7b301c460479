"""Compile the kernels that emulate the camera into numba's cache; `make repro` does it beside the first stages."""

import torch

from polarnet.config.tree import Config, hydra_stage
from polarnet.runtime.machine import generator_for, seed_for
from polarnet.simulation.motion import random_trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.scene import scene_from_polarization

DURATION_US = 20_000  # a few steps


@hydra_stage
def main(config: Config) -> None:
    """Emulate a short motion over a scene without light or polarization."""
    motion, size = config.synthesize, (config.ingest.height, config.ingest.width)
    camera = config.camera.drawn(config.seed, "kernels")
    emulate_motion(
        scene_from_polarization(*torch.zeros(3, *size)),
        random_trajectory(motion, *size, generator_for(config.seed, "kernels", "motion")),
        DURATION_US,
        motion.sensor_height,
        motion.sensor_width,
        camera.sensor,
        seed_for(config.seed, "kernels", "emulate"),
        polarizers=camera.polarizers,
        readout=camera.readout,
        labels=config.storage.labels,
    )


if __name__ == "__main__":
    main()
