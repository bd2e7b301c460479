"""Timed runs of the simulated camera in a process of its own: python -m studies.simulation_run MODEL THREADS

A sensor of 120 x 180 pixels drifts over the coffee photograph at 110 px/s for a second: 300 steps, four channels. Times
run from rendering to columns in memory, with compiled kernels. Peak memory is that of the simulation alone, because
this module imports little else.
"""

import json
import resource
import sys
import time
from dataclasses import replace
from typing import Any

import torch
from skimage import data

from polarnet.runtime.machine import tune
from polarnet.simulation.camera import Camera
from polarnet.simulation.motion import HARMONICS, Sine
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.scene import scene_from_rgb
from studies.simulated_rig import Drift

HEIGHT, WIDTH, DURATION_US, SPEED_PX_S = 120, 180, 1_000_000, 110.0
REPEATS = 9


def timed_run(model: str, threads: int) -> dict[str, Any]:
    """Seconds of each run, events and peak memory of one model in this process, which is set up as stages are."""
    torch.set_num_threads(threads)
    tune()
    scene = scene_from_rgb(torch.from_numpy(data.coffee()).permute(2, 0, 1).float() / 255)
    x, y, still = (scene.width - 1) / 2, (scene.height - 1) / 2, Sine(0.0, 0.0, 0.0)
    path = Drift(x, y, (still,) * HARMONICS, (still,) * HARMONICS, still, still, SPEED_PX_S)
    camera = Camera(replace(SENSORS["default"], model=model), key=1)
    seconds = []
    for _ in range(REPEATS + 1):  # the first compiles
        start = time.perf_counter()
        events = emulate_motion(camera, scene, path, DURATION_US, (HEIGHT, WIDTH), threads)
        seconds.append(time.perf_counter() - start)
    peak_mib = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return {"seconds": seconds[1:], "events": sum(map(len, events)), "peak_mib": peak_mib}


if __name__ == "__main__":
    print(json.dumps(timed_run(sys.argv[1], int(sys.argv[2]))))
