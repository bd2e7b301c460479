"""DoLP from reconstructed intensities, and the wrapper NAME+gain, which first solves the gains of the channels.

Events determine the intensity of a channel only up to a factor. With the true factors g, every pixel of every frame
obeys g0 I0 + g90 I90 = g45 I45 + g135 I135. Many pixels therefore determine the four factors up to a common one,
which cancels in DoLP.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.events.streaming import EventWindow
from polarnet.methods.method import GainConfig, Method, Recoverer, Setup, State
from polarnet.stokes import Prediction, aolp, dolp, stokes_from_intensities

GAIN = "+gain"
SIGNS = (1.0, -1.0, 1.0, -1.0)  # signs of I0, I45, I90 and I135 in I0 + I90 - I45 - I135
DARK = 0.05  # brightness relative to the mean at which a pixel has half weight: dark pixels are noisier
TO_DEVIATION = 1.4826  # from median absolute value to standard deviation, for a normal distribution
RIDGE = 1e-9  # keeps the system solvable if all channels are equal


def from_intensities(intensities: Float[Tensor, "n 4 h w"]) -> Prediction:
    """DoLP and AoLP (Eq. 1-3) from the intensities of the four channels, which must share one scale."""
    stokes = stokes_from_intensities(intensities)
    return Prediction(dolp(stokes), aolp(stokes), intensities=intensities)


def with_gain(method: Method) -> Method:
    """The method NAME+gain, which scales the intensities of `method` so that I0 + I90 = I45 + I135."""

    def open_both(setup: Setup) -> Recoverer:
        inner = method.open(setup)

        def start(height: int, width: int) -> State:
            return inner.start(height, width), None

        def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
            state, earlier = state
            state, prediction = inner.step(state, windows)
            assert prediction.intensities is not None, f"{method.name} reconstructs no intensities"
            images = prediction.intensities if earlier is None else torch.cat([earlier, prediction.intensities])
            known = len(images) - len(windows)
            kept = images[max(0, len(images) + 1 - setup.gain.window_frames) :]
            return (state, kept), from_intensities(consistent(images, setup.gain, known))

        return Recoverer(start, predict, inner.takes_events_once, inner.network)

    label = f"{method.label}, gains solved"
    return dataclasses.replace(method, name=method.name + GAIN, label=label, open=open_both, config=None, wraps=method)


def consistent(intensities: Float[Tensor, "n 4 h w"], config: GainConfig, known: int = 0) -> Float[Tensor, "m 4 h w"]:
    """Intensities at 0, 45, 90 and 135 degrees, multiplied by their `gains`.

    m = n - `known`: the first `known` frames only contribute to the gains of later frames.
    """
    return intensities[known:] * gains(intensities, config, known).to(intensities.dtype)[:, :, None, None]


def gains(intensities: Float[Tensor, "n 4 h w"], config: GainConfig, known: int = 0) -> Float[Tensor, "m 4"]:
    """Gains of each frame after the first `known`, from it and earlier frames; their geometric mean is 1."""
    of_frames = []
    size = intensities[0, 0].numel()
    for end in range(known + 1, len(intensities) + 1):
        frames = intensities[max(0, end - config.window_frames) : end]
        count = len(frames) * size
        chosen = torch.arange(0, count, max(1, -(-count // config.pixels)), device=frames.device)
        pixels = frames.flatten(2)[chosen // size, :, chosen % size].double()
        of_frames.append(solved(pixels * pixels.new_tensor(SIGNS), config))
    return torch.stack(of_frames)


def solved(residuals: Float[Tensor, "n 4"], config: GainConfig) -> Float[Tensor, "4"]:
    """Positive gains g that minimise `residuals` @ g for n pixels of I0, -I45, I90, -I135.

    The fit is least squares. Gains are in units of the gains that make the channels equally bright, and must sum to
    1. Noise therefore draws them towards equal brightness; it would draw the plain null vector (the smallest singular
    vector) towards an arbitrary one. Every pixel is divided by its norm, since its noise is proportional to it.
    Pixels that fit badly get less weight (Cauchy weights, scaled by the median misfit).
    """
    brightness = residuals.square().mean(0).sqrt()
    brightness = torch.where(brightness > 0, brightness, 1.0)
    rows = residuals / brightness
    length = rows.norm(dim=1, keepdim=True)
    rows = rows / (length + DARK * length.mean()).clamp(min=torch.finfo(rows.dtype).tiny)
    weights = torch.ones_like(rows[:, :1])
    for _ in range(config.rounds):
        misfit = (rows @ _smallest(rows.T @ (weights * rows), config)).abs()[:, None]
        weights = 1 / (1 + (misfit / (TO_DEVIATION * misfit.median() + RIDGE)).square())
    solution = _smallest(rows.T @ (weights * rows), config) / brightness
    return solution / solution.log().mean().exp()


def _smallest(form: Float[Tensor, "4 4"], config: GainConfig) -> Float[Tensor, "4"]:
    """The x with x >= `smallest` / 4 and sum 1 that minimises x @ form @ x + `pull` trace(form) x @ x.

    The minimum is exact: the best feasible solution over all choices of entries held at the lower bound.
    """
    size = len(form)
    form = form / form.trace().clamp(min=torch.finfo(form.dtype).tiny)
    form = form + (RIDGE + config.pull) * torch.eye(size, dtype=form.dtype)
    lowest = config.smallest / size
    best, best_value = torch.full_like(form[0], 1 / size), float("inf")
    for held in itertools.product((False, True), repeat=size):
        free = torch.tensor(held).logical_not()
        if not free.any():
            continue
        x = torch.full_like(form[0], lowest)
        pulled = form[free][:, ~free].sum(1) * lowest  # contribution of the entries held at the bound
        both = torch.linalg.solve(form[free][:, free], torch.stack([torch.ones_like(pulled), -pulled], dim=1))
        left = 1 - lowest * (~free).sum()
        x[free] = both[:, 1] + both[:, 0] * (left - both[:, 1].sum()) / both[:, 0].sum()
        value = float(x @ form @ x)
        if value < best_value and bool((x >= lowest * (1 - RIDGE)).all()):
            best, best_value = x, value
        if not any(held) and bool((x >= lowest).all()):
            break
    return best
