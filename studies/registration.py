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
- `offset`: mean squared offset of `ours`, a figure without truth of anything but polarization.

`register` finds the motion (`displacements`, summed over the windows), then solves for four images of log intensity and
their motion in turns. With L the images, P_k the bilinear view of the sensor at time k, N the ON and OFF events of a
pixel so far, c the thresholds and b a pixel's unknown start: P_k L - b = g_on c N_on(k) - g_off c N_off(k) + noise. The
thresholds' errors g ~ N(1, mismatch) and b are integrated out at each pixel, so L is one linear problem, solved by
conjugate gradients. The covariance of a pixel comes from the events of the other three channels. Its own events share
the noise of its sums, which would shrink contrasts.
"""

import statistics
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from torch.nn import functional as F

from polarnet.benchmark.rows import predictions_of
from polarnet.benchmark.sequences import TestSequence
from polarnet.config.pipeline import context_of
from polarnet.events.representations import event_counts
from polarnet.events.streaming import encode_windows
from polarnet.networks.polarnet.panorama import displacements
from polarnet.networks.weights import shipped_weights
from polarnet.runtime.compilation import compiled
from studies.robustness import OURS, conditions_of, simulated, warmup_windows
from studies.scored_pictures import ingested, scenes_of, settings
from studies.study import arguments_of, command_line, machine_record, write_section

THRESHOLD = 0.2  # change of natural-log intensity per event
MISMATCH = 0.15  # relative standard deviation of a pixel's threshold
ROUNDING = 1 / 6  # variance of a sum of events, in squared thresholds, because changes below a threshold are not seen
SLOPE_WEIGHT = 0.01  # of the squared slopes of the images' mean, a weak prior where nothing was seen
MIXING = np.array([[1, 1, 1, 1], [2**0.5, 0, -(2**0.5), 0], [0, 2**0.5, 0, -(2**0.5)], [1, -1, 1, -1]], np.float32) / 2
CONTRAST_WEIGHT = 50  # of the squared slopes of the other three rows of MIXING, relative to those of the mean
REACH = 12  # pixels per window of the motion search
MARGIN = 4  # pixels round the panorama, for corrections of the motion
ROUNDS = (20, 10, 10, 10, 10)  # conjugate-gradient iterations on 2x2 blocks; the motion is corrected between them
LAST_ITERATIONS = 25  # on all pixels
MAX_MOVE = 1.0  # limit in pixels of one correction of the motion
BLOCKS_MISMATCH, BLOCKS_ROUNDING = 0.6, 0.5  # of 2x2 blocks, relative to single pixels
LINE = 4  # pixels, width of a line along the motion
MAX_S = 0.98
FLOOR = 1e-3


class Panorama(NamedTuple):
    """Log intensities behind the four polarizers, each up to a constant, and where the sensor was at each time."""

    images: Float32[np.ndarray, "4 H W"]
    seen: Bool[np.ndarray, "H W"]
    x: Float64[np.ndarray, " k"]
    """Column and row of the panorama at the sensor's first pixel."""
    y: Float64[np.ndarray, " k"]


def register(counts: Float32[np.ndarray, "4 2 k h w"]) -> Panorama:
    """The panorama of a recording, from the numbers of ON and OFF events of each pixel and window."""
    events = np.zeros((4, 2, counts.shape[2] + 1, *counts.shape[3:]), np.float32)
    events[:, :, 1:] = counts.cumsum(2)
    height, width = events.shape[-2:]
    x, y = _summed_displacements(counts)
    size = _even(y.max() + height + 1 + MARGIN), _even(x.max() + width + 1 + MARGIN)
    blocks = events[..., : height // 2 * 2, : width // 2 * 2]
    blocks = blocks.reshape(*events.shape[:3], height // 2, 2, width // 2, 2).mean((4, 6), dtype=np.float32)
    coarse = np.zeros((4, size[0] // 2 + 1, size[1] // 2 + 1), np.float32)
    series = _weights(blocks, BLOCKS_MISMATCH * MISMATCH, BLOCKS_ROUNDING * ROUNDING)
    for number, iterations in enumerate(ROUNDS):
        coarse = _solved(blocks, series, x / 2, y / 2, coarse, iterations, BLOCKS_ROUNDING * ROUNDING)
        if number < len(ROUNDS) - 1:
            dx, dy = _corrections(coarse, blocks, series, x / 2, y / 2)
            x = np.clip(x + 2 * dx, 0, size[1] - width - 1.01)
            y = np.clip(y + 2 * dy, 0, size[0] - height - 1.01)
    start = F.interpolate(torch.from_numpy(coarse)[None, :, :-1, :-1], size, mode="bilinear")
    series = _weights(events, MISMATCH, ROUNDING)
    images = _solved(events, series, x, y, np.ascontiguousarray(start[0].numpy()), LAST_ITERATIONS, ROUNDING)
    return Panorama(images, _coverage(x, y, (height, width), size) > 0.5, x, y)


def views(
    images: Float32[np.ndarray, "c H W"],
    x: Float64[np.ndarray, " k"],
    y: Float64[np.ndarray, " k"],
    size: tuple[int, int],
) -> Float32[np.ndarray, "c k h w"]:
    """Views of images by a sensor of this size, whose first pixel is at columns `x` and rows `y`."""
    out = np.empty((len(images), len(x), *size), np.float32)
    _view(np.ascontiguousarray(images), x, y, out)
    return out


def _summed_displacements(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the sensor at the windows' ends, from the motion between neighbouring windows."""
    images = torch.from_numpy((counts[:, 0] - counts[:, 1]).sum(0))[:, None]
    motion = displacements(images, REACH)
    steps = torch.where(motion.reliable[..., None], motion.displacement, 0.0)[:, 0].double().numpy()
    centres = np.concatenate([np.zeros((1, 2)), steps.cumsum(0)])
    ends = np.concatenate([[1.5 * centres[0] - 0.5 * centres[1]], (centres[1:] + centres[:-1]) / 2,
                           [1.5 * centres[-1] - 0.5 * centres[-2]]])  # fmt: skip
    x, y = (ends - ends.min(0) + MARGIN).T
    return x, y


def _even(length: float) -> int:
    return 2 * int(np.ceil(length / 2))


def _weights(events: np.ndarray, mismatch: float, rounding: float) -> Float32[np.ndarray, "4 3 k h w"]:
    """Orthonormal series of each pixel, shrunk; the inverse covariance is that of `_weigh`, which subtracts them."""
    steps = THRESHOLD * (events.sum(0) - events) / 3  # the other channels see nearly the same, with errors of their own
    series = np.stack([np.ones_like(steps[:, 0]), steps[:, 0], steps[:, 1]], axis=1)
    gram = np.einsum("cmkij,cnkij->cijmn", series, series, optimize=True).astype(np.float64)
    prior = rounding * THRESHOLD**2 / mismatch**2
    gram += np.diag([1e-9, prior, prior])
    values, vectors = np.linalg.eigh(np.linalg.inv(gram))
    roots = (vectors * np.sqrt(values.clip(min=0))[..., None, :]).astype(np.float32)
    return np.ascontiguousarray(np.einsum("cmkij,cijmn->cnkij", series, roots, optimize=True))


def _coverage(x: np.ndarray, y: np.ndarray, size: tuple[int, int], panorama: tuple[int, int]) -> np.ndarray:
    """Number of times at which each pixel of the panorama was seen."""
    out = np.zeros((1, *panorama), np.float32)
    _add_views(np.ones((1, len(x), *size), np.float32), x, y, out)
    return out[0]


def _changes(events: np.ndarray) -> np.ndarray:
    return THRESHOLD * (events[:, 0] - events[:, 1])


def _solved(
    events: np.ndarray,
    series: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    start: np.ndarray,
    iterations: int,
    noise: float,
) -> np.ndarray:
    """Conjugate gradients for the images, with the coverage as preconditioner."""
    slopes = np.float32(SLOPE_WEIGHT * noise / ROUNDING)
    seen = _coverage(x, y, events.shape[-2:], start.shape[-2:])
    inverse = 1 / (seen + slopes * (1 + 3 * CONTRAST_WEIGHT) + np.float32(1e-5))
    buffer = _changes(events)

    def applied(images: np.ndarray) -> np.ndarray:
        _view(images, x, y, buffer)
        _weigh(buffer, series)
        out = np.float32(1e-5) * images
        _add_views(buffer, x, y, out)
        _add_slopes(images, slopes, out)
        return out

    _weigh(buffer, series)
    target = np.zeros_like(start)
    _add_views(buffer, x, y, target)
    images = start.copy()
    residual = target - applied(images)
    step = inverse * residual
    direction, power = step.copy(), (residual * step).sum()
    for _ in range(iterations):
        moved = applied(direction)
        length = power / (direction * moved).sum().clip(min=1e-20)
        images += length * direction
        residual -= length * moved
        step = inverse * residual
        after = (residual * step).sum()
        direction = step + after / power.clip(min=1e-20) * direction
        power = after
    return images


def _corrections(
    images: np.ndarray, events: np.ndarray, series: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step of the motion: changes of `x` and `y` with mean 0."""
    size = events.shape[-2:]
    left = _changes(events) - views(images, x, y, size)
    _weigh(left, series)
    limit = 3 * np.sqrt(np.square(left).mean())
    left = left.clip(-limit, limit)
    across, down = np.zeros_like(images), np.zeros_like(images)
    across[..., 1:-1] = (images[..., 2:] - images[..., :-2]) / 2
    down[:, 1:-1] = (images[:, 2:] - images[:, :-2]) / 2
    gx, gy = views(across, x, y, size), views(down, x, y, size)
    xx, xy, yy, xr, yr = (
        np.einsum("ckij,ckij->k", a, b, optimize=True).astype(np.float64)
        for a, b in ((gx, gx), (gx, gy), (gy, gy), (gx, left), (gy, left))
    )
    ridge = 1e-3 * (xx + yy).mean() + 1e-9
    xx, yy = xx + ridge, yy + ridge
    determinant = xx * yy - xy * xy
    dx, dy = (yy * xr - xy * yr) / determinant, (xx * yr - xy * xr) / determinant
    shorter = np.minimum(1, MAX_MOVE / np.hypot(dx, dy).clip(min=1e-9))
    return dx * shorter - (dx * shorter).mean(), dy * shorter - (dy * shorter).mean()


@compiled
def _view(images, x, y, out):
    for c in range(out.shape[0]):
        for k in range(out.shape[1]):
            top, left = int(y[k]), int(x[k])
            down, right = np.float32(y[k] - top), np.float32(x[k] - left)
            for i in range(out.shape[2]):
                upper, lower, row = images[c, top + i], images[c, top + i + 1], out[c, k, i]
                for j in range(out.shape[3]):
                    above = upper[left + j] + right * (upper[left + j + 1] - upper[left + j])
                    below = lower[left + j] + right * (lower[left + j + 1] - lower[left + j])
                    row[j] = above + down * (below - above)


@compiled
def _add_views(series, x, y, out):
    """The transpose of `_view`, added to `out`."""
    one = np.float32(1)
    for c in range(series.shape[0]):
        for k in range(series.shape[1]):
            top, left = int(y[k]), int(x[k])
            down, right = np.float32(y[k] - top), np.float32(x[k] - left)
            for i in range(series.shape[2]):
                row = series[c, k, i]
                for r, share in ((0, one - down), (1, down)):
                    line = out[c, top + i + r]
                    for j in range(series.shape[3]):
                        line[left + j] += share * (one - right) * row[j]
                    for j in range(series.shape[3]):
                        line[left + j + 1] += share * right * row[j]


@compiled
def _weigh(values, series):
    dots = np.empty(values.shape[3], np.float32)
    for c in range(values.shape[0]):
        for i in range(values.shape[2]):
            for m in range(series.shape[1]):
                dots[:] = 0
                for k in range(values.shape[1]):
                    for j in range(values.shape[3]):
                        dots[j] += series[c, m, k, i, j] * values[c, k, i, j]
                for k in range(values.shape[1]):
                    for j in range(values.shape[3]):
                        values[c, k, i, j] -= series[c, m, k, i, j] * dots[j]


def _add_slopes(images: np.ndarray, weight: np.float32, out: np.ndarray) -> None:
    """The gradient of half the squared slopes of mean and contrasts, times their weights, added to `out`."""
    mixed = np.tensordot(MIXING, images, 1)
    mixed[1:] *= CONTRAST_WEIGHT
    none = np.float32(0)
    bends = sum(np.diff(np.diff(mixed, axis=axis), axis=axis, prepend=none, append=none) for axis in (1, 2))
    out -= weight * np.tensordot(MIXING.T, bends, 1)


def redundant_offset(panorama: Panorama) -> Float64[np.ndarray, " 2"]:
    """Offsets of atanh(s1) and atanh(s2) of the mean-free images by Gauss-Newton on I0 + I90 = I45 + I135."""
    logs = panorama.images[:, panorama.seen].astype(np.float64)
    logs -= logs.mean(1, keepdims=True)
    constants = np.zeros(4)
    for _ in range(30):
        i0, i45, i90, i135 = np.exp(logs + constants[:, None])
        slopes = np.stack([i0 / (i0 + i90), -i45 / (i45 + i135), i90 / (i0 + i90), -i135 / (i45 + i135)])
        excess = np.log((i0 + i90) / (i45 + i135))
        step = np.linalg.solve(slopes @ slopes.T / excess.size + 1e-4 * np.eye(4), slopes @ excess / excess.size)
        constants -= (step - step.mean()) * min(1.0, 0.3 / max(np.abs(step).max(), 1e-9))
    return (constants[:2] - constants[2:]) / 2


def contrasts(panorama: Panorama, size: tuple[int, int], first: int) -> Float32[np.ndarray, "2 k h w"]:
    """atanh(s1) and atanh(s2) at each time from the first scored one on, up to an offset each."""
    images = panorama.images - panorama.images[:, panorama.seen].mean(1)[:, None, None]
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


def _contrasts_of(dolp: np.ndarray, aolp: np.ndarray) -> np.ndarray:
    """atanh(s1) and atanh(s2)."""
    return np.arctanh(MAX_S * dolp * np.stack([np.cos(2 * aolp), np.sin(2 * aolp)]))


def errors_of(test: TestSequence, first: int) -> dict[str, float]:
    """Mean squared errors of DoLP by row, that of each frame's own mean, and the mean squared offset of ours."""
    size = (test.dolp.shape[-2], test.dolp.shape[-1])
    true_dolp, true_aolp = (field[first:].double().numpy() for field in (test.dolp, test.aolp))
    valid = np.ones_like(true_dolp, bool) if test.valid is None else test.valid[first:].numpy()
    truth = _contrasts_of(true_dolp, true_aolp)
    config = settings()
    ours = predictions_of([OURS], test, context_of(config, [OURS], 0.0, shipped_weights()))[OURS]
    assert ours.aolp is not None
    own = _contrasts_of(ours.dolp[first:].double().clamp(0, 1).numpy(), ours.aolp[first:].double().numpy())
    moves = np.array(
        [[np.median((t - o)[v]) for t, o, v in zip(*pair, valid, strict=True)] for pair in zip(truth, own, strict=True)]
    )
    counts = encode_windows(test.events, test.t_us, event_counts).numpy()
    polarity, number = counts[:, 0::2].transpose(1, 0, 2, 3), counts[:, 1::2].transpose(1, 0, 2, 3)
    panorama = register(np.stack([number + polarity, number - polarity], axis=1) / 2)
    found = contrasts(panorama, size, first + 1)
    true_offset = np.array([np.median((t - o)[valid]) for t, o in zip(truth, found, strict=True)])

    def mean_error(dolp: np.ndarray) -> float:
        return float(
            np.mean([np.square(d - t)[v].mean() for d, t, v in zip(dolp, true_dolp, valid, strict=True) if v.any()])
        )

    def mse(contrast: np.ndarray) -> float:
        return mean_error(np.hypot(*np.tanh(contrast)).clip(0, 1))

    means = np.array([t[v].mean() if v.any() else 0.0 for t, v in zip(true_dolp, valid, strict=True)])
    return {
        "oracle_mean": mean_error(np.broadcast_to(means[:, None, None], true_dolp.shape)),
        "ours": mean_error(ours.dolp[first:].clamp(0, 1).numpy()),
        "ours, true offset": mse(own + moves[..., None, None]),
        "panorama, true offset": mse(found + true_offset[:, None, None, None]),
        "panorama, true offset of lines": mse(found + offset_of_lines(panorama, truth - found, valid, first + 1)),
        "panorama, solved": mse(found + redundant_offset(panorama)[:, None, None, None]),
        "offset": float(np.square(moves).mean()),
    }


def table_of(errors: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Ratio of means and of medians over scenes to the oracle mean's MSE, and the mean squared offset."""
    scenes = list(errors.values())
    oracle = [one["oracle_mean"] for one in scenes]
    rows = {}
    for row in scenes[0]:
        values = [one[row] for one in scenes]
        if row not in ("oracle_mean", "offset"):
            rows[row] = {
                "mse_over_oracle_mean": statistics.fmean(values) / statistics.fmean(oracle),
                "median_over_oracle_mean": statistics.median(v / o for v, o in zip(values, oracle, strict=True)),
            }
    return {"scenes": len(scenes), "offset": statistics.fmean(one["offset"] for one in scenes), "rows": rows}


def main() -> None:
    """Measure, print and perhaps write."""
    parser = command_line(__doc__, "section bounds of docs/results/registration.json")
    parser.add_argument("--photographs", type=Path, required=True)
    parser.add_argument("--measured", type=Path, nargs="+", default=[])
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--split", choices=("val", "test"), default="val")
    parser.add_argument("--limit", type=int, help="pictures of each set")
    parser.set_defaults(sensor_limit=None)
    arguments = arguments_of(parser)
    record, config = machine_record(), settings()
    arguments.work.mkdir(parents=True, exist_ok=True)
    photographs = ingested(arguments.photographs, arguments.work / "rgb")
    conditions = conditions_of({"rgb": photographs}, arguments)
    parts = {name: images for name, [(images, _)] in conditions.items() if name.startswith(("photographs", "measured"))}
    errors: dict[str, dict[str, dict[str, float]]] = defaultdict(dict)
    for part, images in parts.items():
        scenes = scenes_of(images, config)
        for name in scenes.sequences:
            one = errors_of(simulated(scenes, name, config), warmup_windows(config))
            errors[part.partition(".")[0]][name] = one
            print(name, {row: round(value / one["oracle_mean"], 2) for row, value in one.items()}, flush=True)
    tables = {part: table_of(of_part) for part, of_part in errors.items()}
    for part, table in tables.items():
        print(part, table, flush=True)
    if arguments.write:
        write_section("registration", "bounds", {"split": arguments.split, "limit": arguments.limit, **tables}, record)


if __name__ == "__main__":
    main()
