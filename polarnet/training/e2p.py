"""Training task of the E2P baseline: events of the four channels in; intensity, AoLP and DoLP out."""

from collections.abc import Mapping
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from pydantic import Field, NonNegativeFloat
from torch import Tensor

from polarnet.events.representations import voxel_grid
from polarnet.events.stream import Events
from polarnet.metrics.lpips import Lpips
from polarnet.networks.e2p.network import BRANCHES, E2p, coded_aolp, interleaved
from polarnet.runtime.sections import section
from polarnet.training.engine.loop import LoopConfig
from polarnet.training.engine.losses import FrameLoss
from polarnet.training.engine.sequences import Windows
from polarnet.training.engine.task import Baseline, Task, initialised


@section
class E2pConfig(LoopConfig):
    """Section `baselines.e2p` of params.yaml; the loss weights are the published ones."""

    bins: Annotated[int, Field(ge=2)]
    """Number of bins of the voxel grid."""
    intensity_lpips: NonNegativeFloat
    """Weight of LPIPS of the intensity, its only loss term. The next three weights apply to AoLP and to DoLP."""
    lpips: NonNegativeFloat
    mse: NonNegativeFloat
    ssim: NonNegativeFloat
    """Weight of 1 - SSIM."""


class BranchLoss(FrameLoss):
    """One `FrameLoss` for each map of E2P. Terms are named after their map, for example dolp_mse."""

    def __init__(self, weights: Mapping[str, Mapping[str, float]], lpips: Lpips | None):
        self._losses = {branch: FrameLoss(weights[branch], lpips) for branch in BRANCHES}
        self.weights = {
            f"{branch}_{term}": weight for branch, loss in self._losses.items() for term, weight in loss.weights.items()
        }

    def __call__(
        self,
        predicted: Float[Tensor, "t b 3 h w"],
        truth: Float[Tensor, "t b 3 h w"],
        valid: Bool[Tensor, "t b h w"] | None = None,
    ) -> dict[str, Float[Tensor, ""]]:
        """Return the unweighted terms by name, over valid pixels only."""
        return {
            f"{branch}_{term}": value
            for i, (branch, loss) in enumerate(self._losses.items())
            for term, value in loss(predicted[:, :, i], truth[:, :, i], valid).items()
        }


def e2p_task(config: E2pConfig, lpips: Lpips | None, seed: int) -> Task:
    """Build the task that trains a new E2P on mosaics of the four channels.

    The truth is S0, AoLP and DoLP. AoLP from -90 to 90 degrees is coded as 0 to 1; the published loss ignores its
    period.
    """
    network = initialised(lambda: E2p(config.bins), seed)

    def encode(events: Events, window_us: int) -> Tensor:
        return voxel_grid(events, config.bins)

    def streams(batch: Windows) -> tuple[Tensor, Tensor, Tensor | None]:
        s0 = batch.intensity[:, :, 0] + batch.intensity[:, :, 2]
        truth = {"intensity": s0, "aolp": coded_aolp(batch.aolp), "dolp": batch.dolp}
        mosaic = interleaved(batch.inputs.unflatten(2, (4, config.bins)))
        return mosaic, torch.stack([truth[branch] for branch in BRANCHES], dim=2), batch.valid

    terms = {"lpips": config.lpips, "mse": config.mse, "ssim_loss": config.ssim}
    return Task(
        network=network,
        encode=encode,
        streams=streams,
        unroll=network.unroll,
        loss=BranchLoss({"intensity": {"lpips": config.intensity_lpips}, "aolp": terms, "dolp": terms}, lpips),
        description={
            "network": "e2p",
            "config": {"bins": config.bins},
            "in_channels": config.bins,
            "representation": "voxel_grid of the mosaic 90 45 / 135 0",
        },
        scored=lambda maps: maps[:, :, BRANCHES.index("dolp")],
    )


BASELINE = Baseline("e2p", E2pConfig, e2p_task, lpips=("lpips", "intensity_lpips"))
