"""Polarization from events alone, solved from the redundancy of four polarizers.

I0 + I90 = I45 + I135. In logarithms, with s1 = S1 / S0 and s2 = S2 / S0: log I0 + log I90 = 2 log(S0 / 2) +
log(1 - s1^2) and likewise for 45, 135 and s2; also log I0 - log I90 = 2 atanh(s1). Let e_k be the change of log I_k.
For small changes,

    (e0 + e90) - (e45 + e135) = -s1 (e0 - e90) + s2 (e45 - e135),

or C = -s1 A + s2 B: one linear equation per pixel, without S0 and without the unknown constants of the logarithms.
Least squares over neighbours and past windows gives s1 and s2.

Thresholds differ between pixels and changes come in whole steps. This noise biases the second moments in the
least-squares problem ("errors in variables"); `SecondMoments` subtracts the expected bias, whose size is trained. The
same equation holds for differences between neighbouring pixels, given an image of each log I_k: `SlopeMoments`.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.polarnet import kernels

MOMENTS = 6  # AA, AB, BB, AC, BC and the weighted number of steps
MIN_EVIDENCE = 1e-2  # squared events, added to AA and BB: without events the solution is 0, not infinite
MAX_CORRELATION = 0.95  # limit on the correlation of A and B, which bias correction can push beyond 1


def faded(
    x: Float[Tensor, " t *b"], keep: Float[Tensor, "*k"], state: Float[Tensor, "*s"] | None
) -> Float[Tensor, " t *s"]:
    """Return running sums after each of t windows; each window multiplies earlier contributions by `keep`.

    `state` is the last sum of the previous windows; None at the start. `x` and `keep` are broadcast to its shape.
    """
    state, sums = x.new_zeros(()) if state is None else state, []
    for now in x:
        state = torch.addcmul(now, state, keep)
        sums.append(state)
    return torch.stack(sums) if len(sums) > 1 else sums[0].unsqueeze(0)


class SecondMoments(nn.Module):
    """Products of A, B and C at each pixel, corrected for the bias from event noise.

    Three numbers are trained for each of the `memories` event sums: the decrease of a pixel's weight with its activity,
    the variance of the relative threshold mismatch, and the variance of a step.
    """

    def __init__(self, memories: int):
        super().__init__()
        self.log_activity = nn.Parameter(torch.full((memories,), -1.0))
        self.log_mismatch = nn.Parameter(torch.full((memories,), -3.5))
        self.log_step = nn.Parameter(torch.full((memories,), -2.0))

    def factors(self) -> Float[Tensor, "3 m"]:
        """Return the trained numbers: decrease with activity, variance of the mismatch, and variance of a step."""
        return torch.stack([self.log_activity, self.log_mismatch, self.log_step]).exp()

    def forward(self, events: Float[Tensor, "n m 4 h w"], pooled: int) -> Float[Tensor, "n m 6 h/{pooled} w/{pooled}"]:
        """Return the `MOMENTS` of the event sums of four channels, averaged over `pooled` x `pooled` pixels."""
        # linear operations follow the pooling, when the images are small: memory traffic dominates the cost
        activity, mismatch, step = self.factors().view(3, -1, 1, 1, 1)
        steps = events.abs()
        weight = 1 / (1 + activity * events.square().sum(2, keepdim=True))
        weighted = weight * steps
        mean_steps, mean_squares = block_means(weighted, pooled), block_means(weighted * steps, pooled)
        v0, v45, v90, v135 = (mismatch * mean_squares + step * mean_steps).unbind(2)
        e0, e45, e90, e135 = events.unbind(2)
        a, b, c = e0 - e90, e45 - e135, (e0 + e90) - (e45 + e135)
        wa, wb = weight[:, :, 0] * a, weight[:, :, 0] * b
        aa, ab, bb, ac, bc = (block_means(product, pooled) for product in (wa * a, wa * b, wb * b, wa * c, wb * c))
        moments = [aa - v0 - v90, ab, bb - v45 - v135, ac - v0 + v90, bc + v45 - v135, mean_steps.sum(2)]
        return torch.stack(moments, dim=2)


class SlopeMoments(nn.Module):
    """Products of the differences between neighbouring pixels in images of A, B and C.

    A trained number sets the decrease of a pixel's weight with its energy: the images' largest errors are at edges.
    """

    def __init__(self):
        super().__init__()
        self.log_activity = nn.Parameter(torch.tensor(-2.3))

    def forward(self, pictures: Float[Tensor, "n 4 h w"]) -> Float[Tensor, "n 7 h/2 w/2"]:
        """Return the `MOMENTS` and the weighted energy, averaged over 2x2 pixels; the sixth moment is the weight.

        `pictures` holds images of the mean, A, B and C, in units of events.
        """
        right = F.pad(pictures[..., 1:] - pictures[..., :-1], (0, 1))
        down = F.pad(pictures[..., 1:, :] - pictures[..., :-1, :], (0, 0, 0, 1))
        slopes = torch.stack([right, down], dim=1)
        energy = slopes.square().sum(2)
        weight = 1 / (1 + self.log_activity.exp() * energy)
        _, a, b, c = slopes.unbind(2)
        wa, wb = weight * a, weight * b
        moments = torch.stack([wa * a, wa * b, wb * b, wa * c, wb * c, weight, weight * energy], dim=2)
        return block_means(moments.sum(1), 2)


class LeastSquares(nn.Module):
    """Least-squares solutions s1, s2 of C = -s1 A + s2 B, from the summed moments of each memory, decay and scale.

    Each solution has its own trained ridge, which pulls it towards 0 where there is little evidence.
    """

    def __init__(self, memories: int, decays: int, scales: int):
        super().__init__()
        self.log_ridge = nn.Parameter(torch.full((memories, decays, scales), -2.5))

    def forward(
        self, moments: Float[Tensor, "n m d k 6 h w"]
    ) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "n c h w"], Float[Tensor, "n c h w"]]:
        """Return s1 and s2, with hypot(s1, s2) <= 1, and the weighted number of steps behind them; c = m * d * k."""
        if kernels.compiled_path(moments):
            n, *candidates, _, height, width = moments.shape
            s1, s2 = moments.new_empty(2, n, math.prod(candidates), height, width)
            ridges, limits = self.log_ridge.exp().flatten(), np.array([MIN_EVIDENCE, MAX_CORRELATION], np.float32)
            flat = moments.flatten(1, 3).flatten(-2).contiguous()
            kernels.least_squares(flat, ridges, *limits, s1.flatten(-2), s2.flatten(-2))
            return s1, s2, moments[:, :, :, :, -1].flatten(1, 3)
        aa, ab, bb, ac, bc, steps = moments.unbind(4)
        ridge = self.log_ridge.exp()[..., None, None] * steps + MIN_EVIDENCE
        aa, bb = F.relu(aa) + ridge, F.relu(bb) + ridge
        limit = MAX_CORRELATION * (aa * bb).sqrt()
        ab = torch.maximum(torch.minimum(ab, limit), -limit)
        determinant = aa * bb - ab * ab
        s1, s2 = (bc * ab - ac * bb) / determinant, (bc * aa - ac * ab) / determinant
        inside = 1 / length(s1, s2).clamp(min=1)
        return tuple(field.flatten(1, 3) for field in (s1 * inside, s2 * inside, steps))  # type: ignore[return-value]


def length(s1: Float[Tensor, "*b"], s2: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Return hypot(s1, s2), with a finite gradient at 0."""
    return torch.sqrt(s1 * s1 + s2 * s2 + 1e-12)


def neighbourhoods(x: Float[Tensor, "n c h w"], scales: Sequence[int]) -> Iterable[Float[Tensor, "n c h w"]]:
    """Yield box means around each pixel for each width in `scales` (odd numbers; 0: mean over the whole image)."""
    for scale in scales:
        if scale == 0:
            yield x.mean((-1, -2), keepdim=True).expand_as(x)
        elif scale == 1:
            yield x
        else:
            yield box_means(x, scale)


def block_means(x: Float[Tensor, "*b h w"], size: int) -> Float[Tensor, "*b h/{size} w/{size}"]:
    """Return means over blocks of `size` x `size` pixels; height and width must be multiples of `size`."""
    # whole rows first, which is faster than avg_pool2d's pixel-by-pixel loop
    rows = x.unflatten(-2, (-1, size)).sum(-2)
    return rows.unflatten(-1, (-1, size)).sum(-1) / size**2


def box_means(x: Float[Tensor, "n c h w"], width: int) -> Float[Tensor, "n c h w"]:
    """Return means over boxes of `width` pixels around each pixel; pixels outside the image do not count.

    Depthwise convolutions of channels_last images, one axis after the other, need fewer additions than pooling.
    """
    channels, rows, columns = x.shape[-3:]
    if kernels.compiled_path(x):
        means = torch.empty(x.shape)
        kernels.box_means(x.reshape(-1, rows, columns), width, means.view(-1, rows, columns))
        return means
    ones = x.new_ones(channels, 1, 1, width)
    with torch.autocast(x.device.type, enabled=False):
        sums = x.float().contiguous(memory_format=torch.channels_last)
        sums = F.conv2d(sums, ones, padding=(0, width // 2), groups=channels)
        sums = F.conv2d(sums, ones.transpose(2, 3), padding=(width // 2, 0), groups=channels)
    return sums / (_inside(rows, width, x)[:, None] * _inside(columns, width, x))


def _inside(pixels: int, width: int, like: Tensor) -> Float[Tensor, " pixels"]:
    """For each pixel of a row, count how many of the `width` pixels around it lie inside the row."""
    middle = torch.arange(pixels, device=like.device)
    return ((middle + width // 2).clamp(max=pixels - 1) - (middle - width // 2).clamp(min=0) + 1).float()
