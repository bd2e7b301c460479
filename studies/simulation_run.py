"""Timed runs of the simulated camera, for `studies.speed` in processes of their own.

A sensor of 120 x 180 pixels drifts over the coffee photograph at 110 px/s for a second: 300 steps, four channels. Times
run from rendering to columns in memory, with compiled kernels. Peak memory is that of the simulation alone, because
this module imports little else.
"""

import resource
import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from skimage import data

from polarnet.runtime.machine import tune
from polarnet.simulation.camera import Camera
from polarnet.simulation.motion import Pose, Trajectory, resting_trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.scene import scene_from_rgb

HEIGHT, WIDTH, DURATION_US, SPEED_PX_S = 120, 180, 1_000_000, 110.0
REPEATS = 9


class Drift(Trajectory):
    """Motion of the sensor to the right at constant speed; x is its position at time 0."""

    @classmethod
    def at(cls, x: float, y: float, speed_px_s: float) -> "Drift":
        """The motion whose centre is at (x, y) at time 0."""
        return cls(**{**vars(resting_trajectory(1, 1)), "x": x, "y": y, "speed_px_s": speed_px_s})

    def pose(self, t_s: Float64[np.ndarray, "*n"]) -> Pose:
        """Pose of the sensor at times in seconds."""
        still = np.zeros_like(t_s)
        return Pose(self.x + self.speed_px_s * t_s, self.y + still, still, still + 1)


def timed_run(model: str, threads: int) -> dict[str, Any]:
    """Seconds of each run, events and peak memory of one model in this process, which is set up as stages are."""
    torch.set_num_threads(threads)
    tune()
    scene = scene_from_rgb(torch.from_numpy(data.coffee()).permute(2, 0, 1).float() / 255)
    path = Drift.at((scene.width - 1) / 2, (scene.height - 1) / 2, SPEED_PX_S)
    camera = Camera(replace(SENSORS["default"], model=model), key=1)
    seconds = []
    for _ in range(REPEATS + 1):  # the first compiles
        start = time.perf_counter()
        events = emulate_motion(camera, scene, path, DURATION_US, (HEIGHT, WIDTH), threads)
        seconds.append(time.perf_counter() - start)
    peak_mib = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return {"seconds": seconds[1:], "events": sum(map(len, events)), "peak_mib": peak_mib}
