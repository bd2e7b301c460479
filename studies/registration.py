"""How far events alone go on real scenes: one panorama of a whole recording, and two numbers that events cannot see.

python -m studies.registration --photographs FOLDER [--measured FOLDER ...] --work FOLDER [--split val|test]
    [--limit N] [--write]

Bounds for ideas, each measured before anything is trained. Per scene, the MSE of DoLP over that of each frame's own
mean; then means over scenes:

- `ours`: the shipped weights; `ours, true offset`: with the true median offset of atanh(s1) and atanh(s2) in each
  frame.
- `panorama, true offset`: `register` on all windows of a recording, with the one true offset of the whole recording.
- `panorama, true offset of lines`: a scene that moves straight is compared with itself along its motion alone, so each
  line along the motion has an offset of its own; this row has all of them, 4 pixels apart.
- `panorama, solved`: the same with the offset that the redundancy I0 + I90 = I45 + I135 gives (`redundant_offset`).
"""

import argparse
import statistics
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

from polarnet.benchmark.rows import predictions_of
from polarnet.benchmark.sequences import TestSequence
from polarnet.config.pipeline import context_of
from polarnet.events.representations import event_counts
from polarnet.events.streaming import encode_windows
from polarnet.methods.registration import Panorama, register, views
from polarnet.metrics.offset import atanh_stokes, dolp_of, offset_scores
from polarnet.metrics.similarity import mse, spread_mse
from polarnet.networks.weights import shipped_weights
from polarnet.stokes import Prediction
from studies.robustness import OURS, conditions_of, simulated, warmup_windows
from studies.scored_pictures import ingested, scenes_of, settings
from studies.study import command_line, measure_sections

THRESHOLD = 0.2  # change of natural-log intensity per event
LINE = 4  # pixels, width of a line along the motion


def redundant_offset(panorama: Panorama) -> Float64[np.ndarray, " 2"]:
    """Offsets of atanh(s1) and atanh(s2) of the mean-free images by Gauss-Newton on I0 + I90 = I45 + I135."""
    logs = THRESHOLD * panorama.images[:, panorama.seen].astype(np.float64)
    logs -= logs.mean(1, keepdims=True)
    constants = np.zeros(4)
    for _ in range(30):
        i0, i45, i90, i135 = np.exp(logs + constants[:, None])
        slopes = np.stack([i0 / (i0 + i90), -i45 / (i45 + i135), i90 / (i0 + i90), -i135 / (i45 + i135)])
        excess = np.log((i0 + i90) / (i45 + i135))
        step = np.linalg.solve(slopes @ slopes.T / excess.size + 1e-4 * np.eye(4), slopes @ excess / excess.size)
        constants -= (step - step.mean()) * min(1.0, 0.3 / max(np.abs(step).max(), 1e-9))
    return (constants[:2] - constants[2:]) / 2


def atanh_of_panorama(panorama: Panorama, size: tuple[int, int], first: int) -> Float32[np.ndarray, "2 k h w"]:
    """atanh(s1) and atanh(s2) at each time from the first scored one on, up to an offset each."""
    images = THRESHOLD * (panorama.images - panorama.images[:, panorama.seen].mean(1)[:, None, None])
    x, y = panorama.x[first:], panorama.y[first:]
    return views((images[:2] - images[2:]) / 2, x, y, size)


def offset_of_lines(
    panorama: Panorama, error: Float64[np.ndarray, "2 k h w"], valid: Bool[np.ndarray, "k h w"], first: int
) -> Float64[np.ndarray, "2 k h w"]:
    """Median of `error` on each line along the main direction of the motion, `LINE` pixels wide."""
    path = np.stack([panorama.x, panorama.y], axis=1)
    across = np.linalg.svd(path - path.mean(0), full_matrices=False)[2][1]
    rows, columns = np.indices(error.shape[-2:])
    at = [x[first:, None, None] + axis for x, axis in ((panorama.x, columns), (panorama.y, rows))]
    line = np.floor((across[0] * at[0] + across[1] * at[1]) / LINE).astype(int)
    line -= line.min()
    medians = np.zeros((2, line.max() + 1))
    for number in np.unique(line[valid]):
        medians[:, number] = np.median(error[:, (line == number) & valid], axis=1)
    return medians[:, line]


def errors_of(test: TestSequence, first: int) -> dict[str, float]:
    """Mean squared errors of DoLP by row, and that of each frame's own mean."""
    size = (test.dolp.shape[-2], test.dolp.shape[-1])
    true_dolp, true_aolp = test.dolp[first:], test.aolp[first:]
    valid = torch.ones_like(true_dolp, dtype=torch.bool) if test.valid is None else test.valid[first:]
    truth = atanh_stokes(true_dolp, true_aolp).double().numpy().swapaxes(0, 1)
    config = settings()
    ours = predictions_of([OURS], test, context_of(config, [OURS], 0.0, shipped_weights()))[OURS]
    ours = Prediction(ours.dolp[first:], None if ours.aolp is None else ours.aolp[first:])
    of_ours = offset_scores(ours, true_dolp, true_aolp, valid)
    counts = encode_windows(test.events, test.t_us, event_counts).numpy()
    polarity, number = counts[:, 0::2].transpose(1, 0, 2, 3), counts[:, 1::2].transpose(1, 0, 2, 3)
    panorama = register(np.stack([number + polarity, number - polarity], axis=1) / 2, config.methods.registration)
    assert panorama is not None, "the test scenes move"
    found, seen = atanh_of_panorama(panorama, size, first + 1), valid.numpy()
    true_offset = np.array([np.median((t - o)[seen]) for t, o in zip(truth, found, strict=True)])

    def mean_error(frames: Tensor) -> float:
        return float(mse(frames.clamp(0, 1), true_dolp, valid).mean())

    def error(contrast: np.ndarray) -> float:
        return mean_error(dolp_of(torch.from_numpy(contrast.swapaxes(0, 1))).float())

    return {
        "oracle_mean": float(spread_mse(true_dolp, valid).mean()),
        "ours": mean_error(ours.dolp),
        "ours, true offset": float(of_ours["no_offset_mse"].mean()),
        "panorama, true offset": error(found + true_offset[:, None, None, None]),
        "panorama, true offset of lines": error(found + offset_of_lines(panorama, truth - found, seen, first + 1)),
        "panorama, solved": error(found + redundant_offset(panorama)[:, None, None, None]),
    }


def table_of(errors: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Ratio of means over scenes to the oracle mean's MSE, and the median of the scenes' ratios, by row."""
    columns = {row: [one[row] for one in errors.values()] for row in next(iter(errors.values()))}
    oracle = columns.pop("oracle_mean")
    rows = {
        row: {
            "mse_over_oracle_mean": statistics.fmean(values) / statistics.fmean(oracle),
            "median_over_oracle_mean": statistics.median(v / o for v, o in zip(values, oracle, strict=True)),
        }
        for row, values in columns.items()
    }
    return {"scenes": len(errors), "rows": rows}


def measure(given: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """Bounds of photographs and of measured scenes."""
    config = settings()
    given.work.mkdir(parents=True, exist_ok=True)
    conditions = conditions_of({"rgb": ingested(given.photographs, given.work / "rgb")}, given)
    errors: dict[str, dict[str, dict[str, float]]] = defaultdict(dict)
    parts = {name: images for name, [(images, _)] in conditions.items() if name.startswith(("photographs", "measured"))}
    for part, images in parts.items():
        scenes = scenes_of(images, config)
        for name in scenes.sequences:
            one = errors_of(simulated(scenes, name, config), warmup_windows(config))
            errors[part.partition(".")[0]][name] = one
            print(name, {row: round(value / one["oracle_mean"], 2) for row, value in one.items()}, flush=True)
    tables = {part: table_of(of_part) for part, of_part in errors.items()}
    return {"split": given.split, "limit": given.limit, **tables}, {}


if __name__ == "__main__":
    parser = command_line(__doc__, "section bounds of docs/results/robustness.json")
    parser.add_argument("--photographs", type=Path, required=True)
    parser.add_argument("--measured", type=Path, nargs="+", default=[])
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--split", choices=("val", "test"), default="val")
    parser.add_argument("--limit", type=int, help="pictures of each set")
    parser.set_defaults(sensor_limit=None)
    measure_sections(parser, {"bounds": ("robustness", "bounds", measure)})
