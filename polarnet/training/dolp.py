"""How the DoLP network is trained: four channels of events in, DoLP out."""

from dataclasses import asdict
from typing import Any

from torch import Tensor

from polarnet.events.representations import REPRESENTATIONS, channels_of
from polarnet.networks.dolp_unet import NETWORKS
from polarnet.similarity import Lpips
from polarnet.training.loop import TrainConfig
from polarnet.training.losses import LossConfig, polarization_loss
from polarnet.training.task import State, Task, initialised


def dolp_task(
    name: str, network_config: Any, config: TrainConfig, loss: LossConfig, lpips: Lpips | None, seed: int
) -> Task:
    """Train the network called `name` (a key of NETWORKS), new and initialised from the seed."""
    build, _ = NETWORKS[name]
    encode = REPRESENTATIONS[config.representation]
    in_channels = 4 * channels_of(encode)
    network = initialised(lambda: build(network_config, in_channels), seed)

    def unroll(inputs: Tensor, state: State) -> tuple[Tensor, State]:
        prediction, state = network.unroll(inputs, state)
        return prediction.dolp, state

    return Task(
        network=network,
        encode=encode,
        streams=lambda batch: (batch.inputs, batch.dolp, batch.valid),
        unroll=unroll,
        loss=polarization_loss(loss, lpips),
        description={
            "network": name,
            "config": asdict(network_config),
            "in_channels": in_channels,
            "representation": config.representation,
        },
    )
