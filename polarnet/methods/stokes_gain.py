"""The factors that four reconstructed intensities lack, from the redundancy of four polarizers.

Events fix the intensity behind a polarizer up to a factor. With the true factors g, every pixel of every frame obeys
g0 I0 + g90 I90 = g45 I45 + g135 I135, so that many pixels give the four up to a common one, which DoLP does not need.
"""

import itertools
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.ranges import allowed, check_ranges

SIGNS = (1.0, -1.0, 1.0, -1.0)  # of 0, 45, 90 and 135 degrees in I0 + I90 - I45 - I135
DARK = 0.05  # pixels this dark against the mean pixel weigh half: their relative noise is larger
TO_DEVIATION = 1.4826  # median of absolute values to standard deviation, of a normal distribution
RIDGE = 1e-9  # keeps the system solvable where every channel is the same picture


@dataclass(frozen=True)
class GainConfig:
    """Section `baselines.gain` of params.yaml."""

    window_frames: int = field(metadata=allowed(low=1))
    """Gains of a frame come from it and the ones before it, this many in all."""
    rounds: int = field(metadata=allowed(low=0))
    """How often pixels are weighted anew by how well they fit; 0: all alike."""
    pixels: int = field(metadata=allowed(low=4))
    """At most this many of the window's pixels are looked at, evenly spread."""
    smallest: float = field(metadata=allowed(above=0, high=1))
    """No gain may fall below this fraction of what would make all four channels equally bright."""
    pull: float = field(metadata=allowed(low=0))
    """Towards equal brightness, against the pixels' mean square: holds gains that the pixels hardly determine."""

    def __post_init__(self):
        check_ranges(self)


def consistent(intensities: Float[Tensor, "n 4 h w"], config: GainConfig, known: int = 0) -> Float[Tensor, "m 4 h w"]:
    """Intensities behind polarizers at 0, 45, 90 and 135 degrees, each times the gain that `gains` finds.

    m = n - `known`: the first `known` frames only contribute to the gains of those after them.
    """
    return intensities[known:] * gains(intensities, config, known).to(intensities.dtype)[:, :, None, None]


def gains(intensities: Float[Tensor, "n 4 h w"], config: GainConfig, known: int = 0) -> Float[Tensor, "m 4"]:
    """Gains of each frame after the first `known`, from it and the ones before it; their geometric mean is 1."""
    ends = range(known + 1, len(intensities) + 1)
    return torch.stack([last_gains(intensities[max(0, end - config.window_frames) : end], config) for end in ends])


def last_gains(intensities: Float[Tensor, "n 4 h w"], config: GainConfig) -> Float[Tensor, "4"]:
    """Of the last frame, from all that are given."""
    frames, _, height, width = intensities.shape
    size = height * width
    looked_at = torch.arange(0, frames * size, max(1, -(-frames * size // config.pixels)), device=intensities.device)
    pixels = intensities.flatten(2)[looked_at // size, :, looked_at % size].double()
    return solved(pixels * pixels.new_tensor(SIGNS), config)


def solved(residuals: Float[Tensor, "n 4"], config: GainConfig) -> Float[Tensor, "4"]:
    """The positive gains g that bring `residuals` @ g nearest to 0, n pixels of I0, -I45, I90, -I135.

    Least squares under the condition that the gains, in units of what makes the channels equally bright, sum to 1.
    Noise therefore draws them towards equal brightness, not towards an arbitrary vector as in the plain null vector
    (the smallest singular one). Every pixel is divided by its own length, as its noise is proportional to it, and
    weighs the less the worse it fits (Cauchy's weights, their scale the median misfit).
    """
    brightness = residuals.square().mean(0).sqrt()
    brightness = torch.where(brightness > 0, brightness, 1.0)
    rows = residuals / brightness
    length = rows.norm(dim=1, keepdim=True)
    rows = rows / (length + DARK * length.mean()).clamp(min=torch.finfo(rows.dtype).tiny)
    weights = torch.ones_like(rows[:, :1])
    for _ in range(config.rounds):
        misfit = (rows @ _smallest(rows.T @ (weights * rows), config.smallest, config.pull)).abs()[:, None]
        weights = 1 / (1 + (misfit / (TO_DEVIATION * misfit.median() + RIDGE)).square())
    found = _smallest(rows.T @ (weights * rows), config.smallest, config.pull) / brightness
    return found / found.log().mean().exp()


def _smallest(form: Float[Tensor, "4 4"], floor: float, pull: float) -> Float[Tensor, "4"]:
    """The x with x >= floor / 4 and sum 1 that makes x @ form @ x + pull trace(form) x @ x smallest.

    Exact: the best of the solutions with each choice of entries held at the floor, where they are allowed.
    """
    size = len(form)
    form = form / form.trace().clamp(min=torch.finfo(form.dtype).tiny)
    form = form + (RIDGE + pull) * torch.eye(size, dtype=form.dtype)
    lowest = floor / size
    best, best_value = torch.full_like(form[0], 1 / size), float("inf")
    for held in itertools.product((False, True), repeat=size):
        free = torch.tensor(held).logical_not()
        if not free.any():
            continue
        x = torch.full_like(form[0], lowest)
        pulled = form[free][:, ~free].sum(1) * lowest  # by the entries that are held
        both = torch.linalg.solve(form[free][:, free], torch.stack([torch.ones_like(pulled), -pulled], dim=1))
        left = 1 - lowest * (~free).sum()
        x[free] = both[:, 1] + both[:, 0] * (left - both[:, 1].sum()) / both[:, 0].sum()
        value = float(x @ form @ x)
        if value < best_value and bool((x >= lowest * (1 - RIDGE)).all()):
            best, best_value = x, value
        if not any(held) and bool((x >= lowest).all()):
            break
    return best
