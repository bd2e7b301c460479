"""Training task of the E2V baseline: events of one channel in, intensity behind its polarizer out."""

from typing import Annotated

from pydantic import Field, NonNegativeFloat
from torch import Tensor

from polarnet.events.representations import normalise_nonzero, voxel_grid
from polarnet.events.stream import Events
from polarnet.metrics.lpips import Lpips
from polarnet.networks.e2v.network import ARCHITECTURES
from polarnet.runtime.sections import one_of, section
from polarnet.training.engine.loop import LoopConfig
from polarnet.training.engine.losses import Loss, frame_terms
from polarnet.training.engine.sequences import Windows
from polarnet.training.engine.task import Baseline, Task, initialised


@section
class E2vConfig(LoopConfig):
    """Section `baselines.e2v` of params.yaml."""

    arch: Annotated[str, one_of(ARCHITECTURES)]
    bins: Annotated[int, Field(ge=2)]
    """Number of bins of the voxel grid."""
    ssim: NonNegativeFloat
    """Weight of 1 - SSIM; the weight of the mean absolute error is 1."""
    lpips: NonNegativeFloat


def e2v_task(config: E2vConfig, lpips: Lpips | None, seed: int) -> Task:
    """Build the task that trains a new network `config.arch`; each channel of a sequence is one stream of the batch.

    The truth is the intensity in [0, 1], with I0 + I90 = S0. All four channels share one scale, because Stokes
    parameters need it.
    """
    network = initialised(lambda: ARCHITECTURES[config.arch](config.bins), seed)

    def encode(events: Events, window_us: int) -> Tensor:
        return normalise_nonzero(voxel_grid(events, config.bins))

    def streams(batch: Windows) -> tuple[Tensor, Tensor, Tensor | None]:
        voxels = batch.inputs.unflatten(2, (4, config.bins))
        valid = None if batch.valid is None else batch.valid.repeat_interleave(4, dim=1)
        return voxels.flatten(1, 2), batch.intensity.flatten(1, 2), valid

    return Task(
        network=network,
        encode=encode,
        streams=streams,
        unroll=network.unroll,
        loss=Loss(frame_terms({"mae": 1.0, "ssim_loss": config.ssim, "lpips": config.lpips}, lpips)),
        description={
            "network": config.arch,
            "config": {"bins": config.bins},
            "in_channels": config.bins,
            "representation": "voxel_grid, nonzero entries normalised",
        },
    )


BASELINE = Baseline(E2vConfig, e2v_task, lpips=("lpips",))
