"""DoLP networks by their names in params.yaml. A new network needs one folder and one entry here."""

import os
from pathlib import Path
from typing import Any

from torch import nn

from polarnet.events.representations import REPRESENTATIONS
from polarnet.networks.base.checkpoint import load_checkpoint, load_tensors, trained_window_us
from polarnet.networks.paper.dolp_unet import DolpUNetConfig
from polarnet.networks.polarnet.stokes_unet import StokesUNetConfig

NetworkConfig = DolpUNetConfig | StokesUNetConfig

NETWORKS: dict[str, type[NetworkConfig]] = {"paper": DolpUNetConfig, "polarnet": StokesUNetConfig}
"""Class of each network's section in params.yaml, which names the network's own class."""


MAX_CHANNELS = 1024  # of the input; a hostile file could ask for any


def load_network(path: str | os.PathLike[str]) -> tuple[nn.Module, dict[str, Any]]:
    """Load a DoLP network in evaluation mode, and its metadata (representation, training, versions).

    >>> from polarnet.networks import load_network, shipped_weights
    >>> network, metadata = load_network(shipped_weights())
    >>> metadata["network"]
    'polarnet'
    """
    tensors, metadata = load_checkpoint(path)
    if metadata.get("network") not in NETWORKS:
        raise ValueError(
            f"{path} holds a {metadata.get('network')!r}; expected a DoLP network, one of {', '.join(NETWORKS)}"
        )
    inputs, representation = metadata.get("in_channels"), metadata.get("representation")
    if not isinstance(inputs, int) or not 0 < inputs <= MAX_CHANNELS or representation not in [*REPRESENTATIONS]:
        raise ValueError(
            f"{Path(path).with_suffix('.json')}: expected in_channels of 1 to {MAX_CHANNELS} and a representation of "
            f"{', '.join(REPRESENTATIONS)}, got {inputs!r} and {representation!r}; train again"
        )
    try:
        config = NETWORKS[metadata["network"]](**metadata["config"])
        trained_window_us(metadata)
    except (TypeError, ValueError) as error:
        reason = str(error).replace("\n", "; ")
        raise ValueError(
            f"{Path(path).with_suffix('.json')}: config of another version of networks.{metadata['network']}: "
            f"{reason}; train again"
        ) from None
    network = config.network_class(config, inputs)
    load_tensors(network, tensors, path)
    return network.eval(), metadata
