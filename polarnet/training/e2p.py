"""Training task of the E2P baseline: events of the four channels in; intensity, AoLP and DoLP out."""

from typing import Annotated

import torch
from pydantic import Field, NonNegativeFloat
from torch import Tensor

from polarnet.events.representations import voxel_grid
from polarnet.events.stream import Events
from polarnet.metrics.lpips import Lpips
from polarnet.networks.e2p.network import BRANCHES, E2p, coded_aolp, interleaved
from polarnet.runtime.sections import section
from polarnet.training.engine.loop import LoopConfig
from polarnet.training.engine.losses import Loss, frame_terms
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

    polarization = {"lpips": config.lpips, "mse": config.mse, "ssim_loss": config.ssim}
    weights = {"intensity": {"lpips": config.intensity_lpips}, "aolp": polarization, "dolp": polarization}
    branches = [frame_terms(weights[branch], lpips, i, f"{branch}_") for i, branch in enumerate(BRANCHES)]
    return Task(
        network=network,
        encode=encode,
        streams=streams,
        unroll=network.unroll,
        loss=Loss(*branches),
        description={
            "network": "e2p",
            "config": {"bins": config.bins},
            "in_channels": config.bins,
            "representation": "voxel_grid of the mosaic 90 45 / 135 0",
        },
        scored=lambda maps: maps[:, :, BRANCHES.index("dolp")],
    )


BASELINE = Baseline(E2pConfig, e2p_task, lpips=("lpips", "intensity_lpips"))
