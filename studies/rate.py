"""Frames between windows (`polarnet recover --rate`): how good they are, and what one costs.

Rows: `ours`, carried on by motion and events; `ours, held`, the last frame of a window unchanged; `ours, window ends`,
the frames of the windows themselves. The first two are scored at 16 times between the ends of two windows.
"""

import itertools
import time
from collections.abc import Mapping, Sequence

import torch

from polarnet.benchmark.between_windows import frames_between
from polarnet.benchmark.resimulate import resimulated, sequence_at
from polarnet.benchmark.rows import Context, opened, predictions_of
from polarnet.benchmark.score import FrameScore, score_sequence
from polarnet.events.stream import Events
from polarnet.events.streaming import EventWindow, WindowCutter, WindowRule
from polarnet.methods import METHODS
from polarnet.methods.between import BetweenConfig, anchored, carried
from polarnet.simulation.camera import Camera
from polarnet.simulation.motion import SynthesizeConfig
from polarnet.stokes import Prediction
from polarnet.storage.scenes import SceneStore

OURS = "ours"
RATE_HZ = 2000
RATED = f"time.{RATE_HZ}hz"
TIMES_BETWEEN = 16
"""Times between the ends of two windows at which the frames of a rate are scored."""
HELD, ENDS = ", held", ", window ends"
"""Endings of the rows beside that of a network: its last frame unchanged, and its frames at the ends of windows."""
FRAME_RATE_HZ = 30.0  # of the windows that `benchmark.warmup_windows` counts
EVENTS_PER_PIXEL = 0.8  # a window; the default sensor's mean
WINDOW_US = round(1e6 / FRAME_RATE_HZ)
VELOCITY = (1e-4, -0.7e-4)  # pixels per microsecond, 4 pixels a window


def rated_scores(
    name: str,
    scenes: SceneStore,
    motion: SynthesizeConfig,
    camera: Camera,
    seed: int,
    warmup: int,
    contexts: Mapping[str, Context],
    between: BetweenConfig,
) -> tuple[list[FrameScore], float]:
    """Scores of the frames between windows and at their ends, from window `warmup` on, and the mean true DoLP.

    `contexts` holds the context of each network by row.
    """
    test = resimulated(scenes, name, motion, [camera] * 4, seed)
    spans = list(itertools.pairwise(test.t_us.tolist()))[warmup + 1 :]
    times = [
        round(start + (stop - start) * (k + 0.5) / TIMES_BETWEEN) for start, stop in spans for k in range(TIMES_BETWEEN)
    ]
    later = sequence_at(scenes, name, test.events, torch.tensor([0, *times]))
    predictions = predictions_of(["oracle_mean"], later, next(iter(contexts.values())))
    at_ends = {}
    for row, context in contexts.items():
        frames = frames_between(test, times, opened(METHODS[OURS], context), between)
        predictions |= {row: frames.carried, row + HELD: frames.held}
        at_ends[row + ENDS] = frames.at_ends
    cpu = torch.device("cpu")
    rows = score_sequence(later, predictions, 0, None, cpu) + score_sequence(test, at_ends, warmup, None, cpu)
    truth = later.dolp if later.valid is None else later.dolp[later.valid]
    return rows, float(truth.mean())


def random_channels(height: int, width: int, windows: int) -> list[Events]:
    """Random events of four channels, as long as this number of windows."""
    generator = torch.Generator().manual_seed(0)
    count = windows * round(EVENTS_PER_PIXEL * height * width)

    def random_channel() -> Events:
        t = torch.randint(0, windows * WINDOW_US, (count,), generator=generator).sort().values
        y, x = (torch.randint(0, size, t.shape, generator=generator).short() for size in (height, width))
        p = torch.randint(0, 2, t.shape, generator=generator) * 2 - 1
        return Events(t, x, y, p.to(torch.int8), height, width)

    return [random_channel() for _ in range(4)]


def windows_of(channels: Sequence[Events], windows: int) -> list[EventWindow]:
    """The first windows of the channels, one after the other."""
    cutter = WindowCutter(WindowRule(WINDOW_US, None, None), channels[0].height, channels[0].width)
    return list(cutter.add(channels, windows * WINDOW_US))


@torch.inference_mode()
def ms_per_frame(height: int, width: int, config: BetweenConfig) -> float:
    """Ms of computation for a frame of the rate, on random events; the search of the motion is shared by a window."""
    channels = random_channels(height, width, 3)
    first, second = windows_of(channels, 2)
    stokes = torch.rand(2, height, width, generator=torch.Generator().manual_seed(0)) - 0.5
    frame = Prediction(torch.hypot(*stokes), torch.zeros(height, width), torch.zeros(height, width), stokes)
    frames = round(RATE_HZ / FRAME_RATE_HZ)
    state = anchored(None, first, frame, config)
    start = time.perf_counter()
    state = anchored(state, second, frame, config)
    state = state._replace(velocity=torch.tensor(VELOCITY))  # random events confirm none
    for number in range(1, frames + 1):
        state, _ = carried(state, channels, second.stop_us + round(1e6 * number / RATE_HZ), config)
    return 1000 * (time.perf_counter() - start) / frames
