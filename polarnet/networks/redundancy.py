"""What the redundancy of four polarizers says about polarization from events alone, without any training.

I0 + I90 = I45 + I135. In logarithms, with s1 = S1 / S0 and s2 = S2 / S0: log I0 + log I90 = 2 log(S0 / 2) +
log(1 - s1^2) and likewise for 45, 135 and s2; also log I0 - log I90 = 2 atanh(s1). So where e_k is how much log I_k has
changed, and changes are small,

    (e0 + e90) - (e45 + e135) = -s1 (e0 - e90) + s2 (e45 - e135):

C = -s1 A + s2 B, one linear equation a pixel, in which S0 and the unknown constants of the logarithms do not occur.
Least squares over neighbours and past windows gives s1 and s2. Events are e_k up to noise: the pixels' thresholds
differ and changes come in whole steps, which biases the second moments that least squares needs ("errors in
variables"). `SecondMoments` takes the expected bias out again; what it takes, and how pixels are weighed, is learnt.

The same holds for changes from place to place where there is a picture of each log I_k: `SlopeMoments`.
"""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

MOMENTS = 6  # AA, AB, BB, AC, BC and the weighted number of steps
LEAST_EVIDENCE = 1e-2  # of a moment, in squared events: keeps the solution finite, and 0, where nothing happened
MOST_CORRELATED = 0.95  # A and B; corrected moments can exceed what those of any A and B could be


def faded(x: Float[Tensor, "t *b"], keep: Float[Tensor, "*k"], state: Float[Tensor, "*s"]) -> Float[Tensor, "t *s"]:
    """Running sums: after each of t windows, what came before counts `keep` times as much as a window earlier.

    `x` and `keep` are broadcast to the shape of `state`.
    """
    sums = []
    for now in x:
        state = torch.addcmul(now, state, keep)
        sums.append(state)
    return torch.stack(sums)


class SecondMoments(nn.Module):
    """Products of A, B and C at each pixel, free of the bias that noise of the events leaves in them.

    For each of `memories` sums of events three numbers are learnt: how strongly a pixel's weight falls with its
    activity, the variance of the relative mismatch of thresholds, and that of a step.
    """

    def __init__(self, memories: int):
        super().__init__()
        self.log_activity = nn.Parameter(torch.full((memories,), -1.0))
        self.log_mismatch = nn.Parameter(torch.full((memories,), -3.5))
        self.log_step = nn.Parameter(torch.full((memories,), -2.0))

    def forward(self, events: Float[Tensor, "n m 4 h w"], pooled: int) -> Float[Tensor, "n m 6 h/{pooled} w/{pooled}"]:
        """`MOMENTS` of the sums of events of the four polarizers, means over blocks of `pooled` x `pooled` pixels.

        What is linear is left for after the pooling, when the images are small: most of the work is memory traffic.
        """
        activity, mismatch, step = (
            p.exp().view(-1, 1, 1, 1) for p in (self.log_activity, self.log_mismatch, self.log_step)
        )
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
    """Products of the differences between neighbouring pixels of pictures of A, B and C.

    What holds for changes in time holds for changes from place to place. How strongly a place's weight falls with its
    energy is learnt: pictures are wrong by most at edges.
    """

    def __init__(self):
        super().__init__()
        self.log_activity = nn.Parameter(torch.tensor(-2.3))

    def forward(self, pictures: Float[Tensor, "n 4 h w"]) -> Float[Tensor, "n 7 h/2 w/2"]:
        """Of a mean, A, B and C in events: `MOMENTS`, the last of them the weight, and then the weighted energy.

        Means over blocks of 2 x 2 pixels.
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
    """s1, s2 that fit C = -s1 A + s2 B best, for summed moments of each memory, decay and scale.

    A ridge for each, learnt, pulls towards 0 where there is little evidence.
    """

    def __init__(self, memories: int, decays: int, scales: int):
        super().__init__()
        self.log_ridge = nn.Parameter(torch.full((memories, decays, scales), -2.5))

    def forward(
        self, moments: Float[Tensor, "n m d k 6 h w"]
    ) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "n c h w"], Float[Tensor, "n c h w"]]:
        """s1, s2 with hypot(s1, s2) <= 1, and the weighted number of steps they rest on; c = m * d * k."""
        aa, ab, bb, ac, bc, steps = moments.unbind(4)
        ridge = self.log_ridge.exp()[..., None, None] * steps + LEAST_EVIDENCE
        aa, bb = F.relu(aa) + ridge, F.relu(bb) + ridge
        limit = MOST_CORRELATED * (aa * bb).sqrt()
        ab = torch.maximum(torch.minimum(ab, limit), -limit)
        determinant = aa * bb - ab * ab
        s1, s2 = (bc * ab - ac * bb) / determinant, (bc * aa - ac * ab) / determinant
        inside = 1 / length(s1, s2).clamp(min=1)
        return tuple(field.flatten(1, 3) for field in (s1 * inside, s2 * inside, steps))  # type: ignore[return-value]


def length(s1: Float[Tensor, "*b"], s2: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """hypot(s1, s2), with a gradient at 0."""
    return torch.sqrt(s1 * s1 + s2 * s2 + 1e-12)


def neighbourhoods(x: Float[Tensor, "n c h w"], scales: Sequence[int]) -> Iterable[Float[Tensor, "n c h w"]]:
    """Means over boxes of so many pixels around each one, an odd number; 0: over the whole image."""
    for scale in scales:
        if scale == 0:
            yield x.mean((-1, -2), keepdim=True).expand_as(x)
        elif scale == 1:
            yield x
        else:
            yield box_means(x, scale)


def block_means(x: Float[Tensor, "*b h w"], size: int) -> Float[Tensor, "*b h/{size} w/{size}"]:
    """Means over blocks of `size` x `size` pixels, which height and width divide into.

    Rows first, whole lines at a time: avg_pool2d goes pixel by pixel.
    """
    rows = x.unflatten(-2, (-1, size)).sum(-2)
    return rows.unflatten(-1, (-1, size)).sum(-1) / size**2


def box_means(x: Float[Tensor, "n c h w"], width: int) -> Float[Tensor, "n c h w"]:
    """Means over boxes of `width` pixels around each one, without what lies outside the image.

    One axis after the other, as depthwise convolutions of channels_last images: fewer additions than pooling.
    """
    channels, rows, columns = x.shape[-3:]
    ones = x.new_ones(channels, 1, 1, width)
    with torch.autocast(x.device.type, enabled=False):
        sums = x.float().contiguous(memory_format=torch.channels_last)
        sums = F.conv2d(sums, ones, padding=(0, width // 2), groups=channels)
        sums = F.conv2d(sums, ones.transpose(2, 3), padding=(width // 2, 0), groups=channels)
    return sums / (inside(rows, width, x)[:, None] * inside(columns, width, x))


def inside(pixels: int, width: int, like: Tensor) -> Float[Tensor, " pixels"]:
    """How many of `width` pixels around each of a row lie in it."""
    middle = torch.arange(pixels, device=like.device)
    return ((middle + width // 2).clamp(max=pixels - 1) - (middle - width // 2).clamp(min=0) + 1).float()
