"""Training task of the DoLP networks: events of four channels in; DoLP out, and AoLP if the network predicts it."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.events.representations import REPRESENTATIONS, channels_of
from polarnet.metrics.lpips import Lpips
from polarnet.networks.base.checkpoint import load_checkpoint, load_tensors
from polarnet.training.engine.loop import TrainConfig
from polarnet.training.engine.losses import LossConfig, polarization_loss
from polarnet.training.engine.sequences import Windows
from polarnet.training.engine.task import State, Task, initialised

FITTED = "expected."  # tensors of the expected errors, which every training fits anew


def dolp_task(
    name: str, network_config: Any, config: TrainConfig, loss: LossConfig, lpips: Lpips | None, seed: int
) -> Task:
    """Build the task that trains a network `name` (a key of section `networks`), from the seed or from `config.start`.

    The expected errors of `config.start` are left out. The truth is a stack of DoLP, s1 and s2; the prediction is the
    same stack, or DoLP alone. ValueError if the checkpoint holds another network, FileNotFoundError if there is none.
    """
    build = network_config.network_class
    representation = config.representation or build.representation
    encode = REPRESENTATIONS[representation]
    in_channels = 4 * channels_of(encode)
    network = initialised(lambda: build(network_config, in_channels), seed)
    start: dict[str, str] = {}
    if config.start is not None:
        tensors, known = load_checkpoint(config.start)
        unfitted = {key: tensor for key, tensor in network.state_dict().items() if key.startswith(FITTED)}
        load_tensors(network, tensors | unfitted, Path(config.start))
        start = {"start_sha256": known["sha256"]}

    def unroll(inputs: Tensor, state: State) -> tuple[Float[Tensor, "t b k h w"], State]:
        prediction, state = network.unroll(inputs, state)
        maps = prediction.dolp[:, :, None]
        if prediction.stokes is not None:
            maps = torch.cat([maps, prediction.stokes], dim=2)
        return maps, state

    return Task(
        network=network,
        encode=encode,
        streams=lambda batch: (batch.inputs, normalised_stokes(batch), batch.valid),
        unroll=unroll,
        loss=polarization_loss(loss, lpips, dolp_only=not build.predicts_stokes),
        description={
            "network": name,
            "config": asdict(network_config),
            "in_channels": in_channels,
            "representation": representation,
            "half_weight": loss.half_weight,
            **start,
        },
        wants_intensity=False,
        optimizer=config.optimizer or build.optimizer,
        scored=lambda maps: maps[:, :, 0],
        scene_dolp=config.scene_dolp,
    )


def normalised_stokes(batch: Windows) -> Float[Tensor, "t b 3 h w"]:
    """Stack the truth of a batch: DoLP, s1 = S1 / S0 and s2 = S2 / S0."""
    angle = 2 * batch.aolp
    return torch.stack([batch.dolp, batch.dolp * torch.cos(angle), batch.dolp * torch.sin(angle)], dim=2)
