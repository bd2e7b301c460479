"""Light, motion and sensors that several tests of the simulation share."""

import dataclasses

import torch

from polarnet.simulation.motion import HARMONICS, Sine
from polarnet.simulation.presets import SENSORS

QUIET = dataclasses.replace(SENSORS["clean"], contrast_threshold_sigma_on=0.0, contrast_threshold_sigma_off=0.0)
"""A sensor without noise or mismatch."""
STILL = Sine(0.0, 0.0, 0.0)
REST = (STILL,) * HARMONICS


def moving_bars(channels: int = 4) -> torch.Tensor:
    """Twelve frames of some channels in which bright and dark bars of 0 to 255 DN drift."""
    phase = torch.arange(40.0) / 6 - torch.arange(12.0).view(-1, 1, 1, 1) / 3
    amplitude = torch.linspace(20, 127, channels).view(1, -1, 1, 1) * torch.linspace(0.5, 1, 24).view(1, 1, 24, 1)
    return 127.5 + amplitude * torch.sin(phase)


def picture(height: int = 72, width: int = 96) -> torch.Tensor:
    """A smooth RGB picture."""
    coarse = torch.rand(1, 3, 9, 12, generator=torch.Generator().manual_seed(2))
    return torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")[0]
