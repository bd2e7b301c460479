"""Scores of the frames between windows (`polarnet recover --rate`).

Rows: `ours`, carried on by motion and events; `ours, held`, the last frame of a window unchanged; `ours, window ends`,
the frames of the windows themselves. The first two are scored at 16 times between the ends of two windows.
"""

import itertools
from collections.abc import Mapping

import torch

from polarnet.analysis.between_windows import frames_between
from polarnet.analysis.resimulate import resimulated, sequence_at
from polarnet.benchmark.rows import Context, opened, predictions_of
from polarnet.benchmark.score import FrameScore, score_sequence
from polarnet.methods import METHODS
from polarnet.methods.between import BetweenConfig
from polarnet.simulation.camera import Camera
from polarnet.simulation.motion import SynthesizeConfig
from polarnet.storage.scenes import SceneStore

OURS = "ours"
RATE_HZ = 2000
RATED = f"time.{RATE_HZ}hz"
TIMES_BETWEEN = 16
"""Times between the ends of two windows at which the frames of a rate are scored."""
HELD, ENDS = ", held", ", window ends"
"""Endings of the rows beside that of a network: its last frame unchanged, and its frames at the ends of windows."""
FRAME_RATE_HZ = 30.0  # of the windows that `benchmark.warmup_windows` counts


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
