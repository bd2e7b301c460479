"""Contrast threshold of a sensor, estimated from its events.

The logarithm of light scaled by a factor gives the same events as a threshold divided by it. Events alone therefore
cannot separate the threshold from the contrast of the scene. But contrasts differ less between scenes than thresholds
between sensors, and a lower threshold usually comes with a larger relative mismatch. A small perceptron weighs these
clues; the loss of DoLP trains it.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

FEATURES = 6
HIDDEN = 16
MAX_LOG_SCALE = 1.5  # limit of the estimate's logarithm
MIN_FEATURE = 0.01  # added to features, in steps, before their logarithm


class Scale(nn.Module):
    """The change of log intensity per event, relative to `panorama_step`."""

    given: float | None = None
    """Known value, which replaces the estimate; None: unknown."""

    def __init__(self):
        super().__init__()
        self.hidden = nn.Linear(FEATURES, HIDDEN)
        self.out = nn.Linear(HIDDEN, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Float[Tensor, "n k"]) -> Float[Tensor, "n 1 1 1"]:
        """Return the scale of each of n images, for features from `scale_features`."""
        if self.given is not None:
            return features.new_full((len(features), 1, 1, 1), self.given)
        with torch.autocast(features.device.type, enabled=False):
            log_scale = self.out(torch.tanh(self.hidden(features)))
            return log_scale.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE).exp()[..., None, None]


def scale_features(
    panorama: Float[Tensor, "n 4 h w"], total: Float[Tensor, " n"], mismatch: Float[Tensor, " n"]
) -> Float[Tensor, "n k"]:
    """Compute the features of `Scale` from the panorama in steps, the events per pixel so far, and the mismatch.

    The features are the logarithms of:

    - the standard deviation of the mean of the four channels, and that of the two contrasts,
    - the mean absolute slope of the mean, and that of the contrasts,
    - the number of events,

    and the standard deviation of relative sensitivities.
    """
    parts = (panorama[:, :1], panorama[:, 1:3])
    spreads = [part.flatten(2).var(-1).mean(1).sqrt() for part in parts]
    slopes = [(_mean_step(part, -1) + _mean_step(part, -2)) / 2 for part in parts]
    logs = [torch.log(one + MIN_FEATURE) for one in (*spreads, *slopes, total)]
    return torch.stack([*logs, mismatch.sqrt()], dim=1)


def _mean_step(images: Float[Tensor, "n c h w"], axis: int) -> Float[Tensor, " n"]:
    """Return the mean absolute difference of neighbours along an axis."""
    return images.diff(dim=axis).abs().mean((1, 2, 3))
