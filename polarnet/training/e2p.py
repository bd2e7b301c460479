"""How the E2P baseline is trained: the four polarizers' events in; intensity, AoLP and DoLP out."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from polarnet.events.representations import voxel_grid
from polarnet.events.stream import Events
from polarnet.networks.e2p import BRANCHES, E2p, coded_aolp, interleaved
from polarnet.ranges import allowed
from polarnet.similarity import Lpips
from polarnet.training.loop import LoopConfig
from polarnet.training.losses import FrameLoss
from polarnet.training.sequences import Batch
from polarnet.training.task import Task, initialised


@dataclass(frozen=True)
class E2pConfig(LoopConfig):
    """Section `baselines.e2p` of params.yaml; the weights of the loss are the published ones."""

    bins: int = field(metadata=allowed(low=2))
    """Of the voxel grid."""
    intensity_lpips: float = field(metadata=allowed(low=0))
    """The only term of the intensity; the next three are those of AoLP and of DoLP."""
    lpips: float = field(metadata=allowed(low=0))
    mse: float = field(metadata=allowed(low=0))
    ssim: float = field(metadata=allowed(low=0))
    """Of 1 - SSIM."""


class BranchLoss(FrameLoss):
    """A `FrameLoss` for each map of E2P, its terms named after the map: dolp_mse."""

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
        """The terms by name, without their weights; of the valid pixels alone."""
        return {
            f"{branch}_{term}": value
            for i, (branch, loss) in enumerate(self._losses.items())
            for term, value in loss(predicted[:, :, i], truth[:, :, i], valid).items()
        }


def e2p_task(config: E2pConfig, lpips: Lpips | None, seed: int) -> Task:
    """Train a new E2P on mosaics made of the four channels.

    The truth is S0, AoLP from -90 to 90 degrees as 0 to 1, which the published loss compares without regard to its
    period, and DoLP.
    """
    network = initialised(lambda: E2p(config.bins), seed)

    def encode(events: Events, window_us: int) -> Tensor:
        return voxel_grid(events, config.bins)

    def streams(batch: Batch) -> tuple[Tensor, Tensor, Tensor | None]:
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
