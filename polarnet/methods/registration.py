"""Registration: one panorama of all windows of a recording, by least squares.

`register` finds the motion (`displacements`, summed over the windows), then solves for four images of log intensity and
their motion in turns. With L the images in steps (contrast thresholds), P_k the bilinear view of the sensor at time k,
N the ON and OFF events of a pixel so far and b a pixel's unknown start: P_k L - b = g_on N_on(k) - g_off N_off(k) +
noise. The thresholds' errors g ~ N(1, mismatch) and b are integrated out at each pixel, so L is one linear problem,
solved by conjugate gradients. The covariance of a pixel comes from the events of the other three channels. Its own
events share the noise of its sums, which would shrink contrasts.

Events tell each image up to a constant, and less than that if the camera moves straight. It then compares the scene
with itself along its motion alone, so each line along the motion has a constant of its own. `offset_field` takes the
constants from maps that know them, such as a network's.
"""

from typing import Annotated, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from numba import prange
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from scipy import sparse
from scipy.sparse.linalg import splu
from torch.nn import functional as F

from polarnet.networks.polarnet.panorama import displacements
from polarnet.networks.polarnet.redundancy import block_means
from polarnet.runtime.compilation import inlined, parallel
from polarnet.runtime.sections import section

MIXING = np.array([[1, 1, 1, 1], [2**0.5, 0, -(2**0.5), 0], [0, 2**0.5, 0, -(2**0.5)], [1, -1, 1, -1]], np.float32) / 2
MARGIN = 4  # pixels round the panorama, for corrections of the motion
ROUNDS = (20, 10, 10, 10, 10)  # conjugate-gradient iterations on 2x2 blocks; the motion is corrected between them
LAST_ITERATIONS = 25  # on all pixels
MAX_MOVE = 1.0  # limit in pixels of one correction of the motion
BLOCKS_MISMATCH, BLOCKS_ROUNDING = 0.6, 0.5  # of 2x2 blocks, relative to single pixels
SHORTEST_PATH = 4.0  # pixels
BLOCK = 4  # side in pixels of the blocks that have an offset
UNSEEN = 1e-4  # weight of parts without events, which keeps their offsets finite
NEAR = 9  # side in pixels of the square round a pixel whose changes are compared with the panorama's


@section
class RegistrationConfig:
    """Section `methods.registration` of params.yaml: the panorama of `registered`, and how it joins the network's."""

    reach: PositiveInt
    """Search range in pixels for the motion per window, along each axis."""
    mismatch: PositiveFloat
    """Relative standard deviation of the contrast threshold between pixels."""
    rounding: PositiveFloat
    """Variance of a pixel's sum of events in squared steps, because changes below a threshold are not seen."""
    smoothness: PositiveFloat
    """Weight of the squared slopes of the mean of the four images, relative to one view of a pixel."""
    contrast_smoothness: PositiveFloat
    """The same of the contrasts between the images, relative to that of their mean."""
    share: Annotated[float, Field(ge=0, le=1)]
    """Weight of the panorama in atanh(s1) and atanh(s2); the network's maps have the rest."""
    along: PositiveFloat
    """Stiffness of the offsets between panorama and network along the motion, relative to one block of 4x4 pixels."""
    across: PositiveFloat
    """The same across the motion."""
    unexplained: Annotated[list[NonNegativeFloat], Field(min_length=2, max_length=2)]
    """Share of the changes that the panorama may leave unexplained: up to the first number the joined maps count
    wholly, from the second on the network's alone."""
    windows: Annotated[int, Field(ge=2, le=10_000)]
    """Windows of a recording that are registered together, in addition to `overlap` earlier ones."""
    overlap: Annotated[int, Field(ge=0, le=10_000)]


class Panorama(NamedTuple):
    """Log intensities behind the four polarizers, each up to a constant, and where the sensor was at each time."""

    images: Float32[np.ndarray, "4 H W"]
    """In steps."""
    seen: Bool[np.ndarray, "H W"]
    x: Float64[np.ndarray, " k"]
    """Column and row of the panorama at the sensor's first pixel."""
    y: Float64[np.ndarray, " k"]


class _Pixels(NamedTuple):
    """Least-squares problem of a sensor's pixels, or of blocks of them."""

    events: Float32[np.ndarray, "4 2 k h w"]
    """ON and OFF events so far."""
    series: Float32[np.ndarray, "4 3 k h w"]
    """Orthonormal series of each pixel (`_weights`)."""
    smoothness: Float32[np.ndarray, " 4"]
    """Weights of the squared slopes of the rows of MIXING: the images' mean, and their contrasts."""


def _pixels(events: np.ndarray, config: RegistrationConfig, mismatch: float, rounding: float) -> _Pixels:
    """The problem of pixels whose mismatch and rounding are smaller by factors."""
    series = _weights(events, mismatch * config.mismatch, rounding * config.rounding)
    mean = rounding * config.smoothness
    contrast = mean * config.contrast_smoothness
    return _Pixels(events, series, np.array([mean, contrast, contrast, contrast], np.float32))


def register(counts: Float32[np.ndarray, "4 2 k h w"], config: RegistrationConfig) -> Panorama | None:
    """The panorama of a recording, from the numbers of ON and OFF events of each pixel and window.

    None if the scene moves less than SHORTEST_PATH, too little to be compared with itself.
    """
    x, y = _summed_displacements(counts, config.reach)
    if np.hypot(np.ptp(x), np.ptp(y)) < SHORTEST_PATH:
        return None
    events = _sums(counts)
    height, width = events.shape[-2:]
    size = _even(y.max() + height + 1 + MARGIN), _even(x.max() + width + 1 + MARGIN)
    blocks = events[..., : height // 2 * 2, : width // 2 * 2]
    blocks = blocks.reshape(*events.shape[:3], height // 2, 2, width // 2, 2).mean((4, 6), dtype=np.float32)
    pixels = _pixels(blocks, config, BLOCKS_MISMATCH, BLOCKS_ROUNDING)
    coarse = np.zeros((4, size[0] // 2 + 1, size[1] // 2 + 1), np.float32)
    for number, iterations in enumerate(ROUNDS):
        coarse = _solved(pixels, x / 2, y / 2, coarse, iterations)
        if number < len(ROUNDS) - 1:
            dx, dy = _corrections(coarse, pixels, x / 2, y / 2)
            x = np.clip(x + 2 * dx, 0, size[1] - width - 1.01)
            y = np.clip(y + 2 * dy, 0, size[0] - height - 1.01)
    start = F.interpolate(torch.from_numpy(coarse)[None, :, :-1, :-1], size, mode="bilinear")[0].numpy()
    images = _solved(_pixels(events, config, 1.0, 1.0), x, y, np.ascontiguousarray(start), LAST_ITERATIONS)
    return Panorama(images, _coverage(x, y, (height, width), size) > 0.5, x, y)


def at_rest(height: int, width: int, times: int) -> Panorama:
    """The panorama of a sensor that does not move: one view, without contrasts."""
    size = _even(height + 1 + 2.0 * MARGIN), _even(width + 1 + 2.0 * MARGIN)
    place = np.full(times, float(MARGIN))
    return Panorama(np.zeros((4, *size), np.float32), np.ones(size, bool), place, place)


def unexplained(panorama: Panorama, counts: Float32[np.ndarray, "4 2 k h w"]) -> Float32[np.ndarray, "h w"]:
    """Energy of the changes that the panorama leaves over around each pixel, as a share of their energy.

    Objects that move in another way than the panorama leave most of theirs.
    """
    changes = _changes(_sums(counts))
    left = changes - views(panorama.images, panorama.x, panorama.y, counts.shape[-2:])
    of_left, of_all = (
        torch.from_numpy(np.square(one - one.mean(1, keepdims=True)).sum((0, 1)))[None] for one in (left, changes)
    )
    near = [F.avg_pool2d(one, NEAR, 1, NEAR // 2, count_include_pad=False)[0] for one in (of_left, of_all)]
    return (near[0] / near[1].clamp(min=UNSEEN)).numpy()


def _sums(counts: np.ndarray) -> Float32[np.ndarray, "4 2 k1 h w"]:
    """Events so far, at the start and at the end of each window."""
    events = np.zeros((4, 2, counts.shape[2] + 1, *counts.shape[3:]), np.float32)
    events[:, :, 1:] = counts.cumsum(2)
    return events


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


def _summed_displacements(counts: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the sensor at the windows' ends, from the motion between neighbouring windows."""
    images = torch.from_numpy((counts[:, 0] - counts[:, 1]).sum(0))[:, None]
    motion = displacements(images, reach)
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
    others = (events.sum(0) - events) / 3  # the other channels see nearly the same, with errors of their own
    series = np.empty((4, 3, *events.shape[2:]), np.float32)
    series[:, 0] = events.shape[2] ** -0.5
    on, off = np.moveaxis(others - others.mean(2, keepdims=True), 1, 0)
    prior = np.float32(rounding / mismatch**2)
    power = np.square(on).sum(1) + prior
    share = (on * off).sum(1) / power
    series[:, 1] = on / np.sqrt(power)[:, None]
    off = off - share[:, None] * on
    series[:, 2] = off / np.sqrt(np.square(off).sum(1) + prior * (1 + share**2))[:, None]
    return series


def _coverage(x: np.ndarray, y: np.ndarray, size: tuple[int, int], panorama: tuple[int, int]) -> np.ndarray:
    """Number of times at which each pixel of the panorama was seen."""
    out = np.zeros((1, *panorama), np.float32)
    _add_views(np.ones((1, len(x), *size), np.float32), x, y, out)
    return out[0]


def _changes(events: np.ndarray) -> np.ndarray:
    """In steps, since the start."""
    return events[:, 0] - events[:, 1]


def _solved(pixels: _Pixels, x: np.ndarray, y: np.ndarray, start: np.ndarray, iterations: int) -> np.ndarray:
    """Conjugate gradients for the images, with the coverage as preconditioner."""
    events, series, weights = pixels
    seen = _coverage(x, y, events.shape[-2:], start.shape[-2:])
    inverse = 1 / (seen + weights.sum() + np.float32(1e-5))

    def applied(images: np.ndarray) -> np.ndarray:
        out = np.float32(1e-5) * images
        _add_weighed_views(images, x, y, series, out)
        _add_slopes(images, weights, out)
        return out

    changes, target = _changes(events), np.zeros_like(start)
    _weigh(changes, series)
    _add_views(changes, x, y, target)
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


def _corrections(images: np.ndarray, pixels: _Pixels, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step of the motion: changes of `x` and `y` with mean 0."""
    events, series = pixels.events, pixels.series
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


@inlined
def _view_row(image, x, y, i, row):
    """Row i of the sensor at one time."""
    top, left = int(y), int(x)
    down, right = np.float32(y - top), np.float32(x - left)
    upper, lower = image[top + i, left:], image[top + i + 1, left:]
    for j in range(row.size):
        above = upper[j] + right * (upper[j + 1] - upper[j])
        below = lower[j] + right * (lower[j + 1] - lower[j])
        row[j] = above + down * (below - above)


@inlined
def _add_row(row, x, y, i, out):
    """The transpose of `_view_row`, added to `out`."""
    one = np.float32(1)
    top, left = int(y), int(x)
    down, right = np.float32(y - top), np.float32(x - left)
    for r, share in ((0, one - down), (1, down)):
        line, following = out[top + i + r, left:], out[top + i + r, left + 1 :]
        for j in range(row.size):
            line[j] += share * (one - right) * row[j]
        for j in range(row.size):
            following[j] += share * right * row[j]


@inlined
def _weigh_row(rows, series, i, dots):
    """Subtract the `series` m k h w of row i from its values at all times."""
    for m in range(series.shape[0]):
        dots[:] = 0
        for k in range(rows.shape[0]):
            for j in range(dots.size):
                dots[j] += series[m, k, i, j] * rows[k, j]
        for k in range(rows.shape[0]):
            for j in range(dots.size):
                rows[k, j] -= series[m, k, i, j] * dots[j]


@parallel
def _view(images, x, y, out):
    for c in prange(out.shape[0]):
        for k in range(out.shape[1]):
            for i in range(out.shape[2]):
                _view_row(images[c], x[k], y[k], i, out[c, k, i])


@parallel
def _add_views(values, x, y, out):
    """The transpose of `_view`, added to `out`."""
    for c in prange(values.shape[0]):
        for k in range(values.shape[1]):
            for i in range(values.shape[2]):
                _add_row(values[c, k, i], x[k], y[k], i, out[c])


@parallel
def _weigh(values, series):
    for c in prange(values.shape[0]):
        dots = np.empty(values.shape[3], np.float32)
        for i in range(values.shape[2]):
            _weigh_row(values[c, :, i], series[c], i, dots)


@parallel
def _add_weighed_views(images, x, y, series, out):
    """`_view`, `_weigh` and `_add_views`, row by row, so that the views stay in the cache."""
    for c in prange(series.shape[0]):
        rows = np.empty((series.shape[2], series.shape[4]), np.float32)
        dots = np.empty(series.shape[4], np.float32)
        for i in range(series.shape[3]):
            for k in range(series.shape[2]):
                _view_row(images[c], x[k], y[k], i, rows[k])
            _weigh_row(rows, series[c], i, dots)
            for k in range(series.shape[2]):
                _add_row(rows[k], x[k], y[k], i, out[c])


def _add_slopes(images: np.ndarray, weights: Float32[np.ndarray, " 4"], out: np.ndarray) -> None:
    """The gradient of half the squared slopes of the rows of MIXING, times their weights, added to `out`."""
    mixed = np.tensordot(MIXING, images, 1)
    none = np.float32(0)
    bends = sum(np.diff(np.diff(mixed, axis=axis), axis=axis, prepend=none, append=none) for axis in (1, 2))
    out -= np.tensordot(MIXING.T * weights, bends, 1)


def mosaic(
    maps: Float32[np.ndarray, "c k h w"],
    weight: Float32[np.ndarray, "k h w"],
    panorama: Panorama,
) -> tuple[Float32[np.ndarray, "c H W"], Float32[np.ndarray, "H W"]]:
    """Weighted means of the sensor's maps at the last k times, as the panorama sees them, and their total weights."""
    sums = np.zeros((len(maps) + 1, *panorama.images.shape[1:]), np.float32)
    x, y = (axis[-len(weight) :] for axis in (panorama.x, panorama.y))
    _add_views(np.concatenate([maps * weight, weight[None]], dtype=np.float32), x, y, sums)
    return sums[:-1] / sums[-1].clip(min=1e-6), sums[-1]


def offset_field(
    difference: Float32[np.ndarray, "c H W"],
    weight: Float32[np.ndarray, "H W"],
    panorama: Panorama,
    config: RegistrationConfig,
) -> Float32[np.ndarray, "c H W"]:
    """Smooth images of a weighted difference: stiff along the motion, which the panorama compares, soft across it."""
    size = weight.shape
    weights = _blocks(weight)
    coarse = _blocks(difference * weight) / weights.clip(min=1e-6)
    weights /= weights.mean()
    path = np.stack([np.diff(panorama.x), np.diff(panorama.y)])
    along = path @ path.T / np.square(path).sum().clip(min=1e-9)
    slopes = _corner_slopes(*weights.shape)
    stiffness = config.along * along + config.across * np.eye(2)
    system = sparse.diags_array(weights.ravel() + UNSEEN)
    for i, one in enumerate(slopes):
        for j, other in enumerate(slopes):
            system = system + stiffness[i, j] * (one.T @ other)
    solve = splu(system.tocsc()).solve
    offsets = [solve((weights * one).ravel().astype(np.float64)).reshape(weights.shape) for one in coarse]
    enlarged = F.interpolate(torch.from_numpy(np.stack(offsets)).float()[None], scale_factor=BLOCK, mode="bilinear")
    return enlarged[0, :, : size[0], : size[1]].numpy()


def _blocks(image: np.ndarray) -> np.ndarray:
    """Means over blocks of BLOCK x BLOCK pixels; the last rows and columns are repeated to fill the last blocks."""
    rows, columns = (-side % BLOCK for side in image.shape[-2:])
    padded = np.pad(image, [(0, 0)] * (image.ndim - 2) + [(0, rows), (0, columns)], mode="edge")
    return block_means(torch.from_numpy(padded), BLOCK).numpy()


def _corner_slopes(height: int, width: int) -> tuple[sparse.sparray, sparse.sparray]:
    """Slopes along x and y at the corners between four blocks, as matrices."""
    steps, means = ([sparse.diags_array(pair, offsets=[0, 1], shape=(side - 1, side)) for side in (height, width)]
                    for pair in ([-1.0, 1.0], [0.5, 0.5]))  # fmt: skip
    return sparse.kron(means[0], steps[1]), sparse.kron(steps[0], means[1])
