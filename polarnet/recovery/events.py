"""Recovery of events in memory by the DoLP network."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Int64
from torch import Tensor

from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import TRAINED_WINDOW_US, EventWindow, windows_of
from polarnet.methods.dolp_network import dolp_recoverer
from polarnet.networks.registry import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.stokes import POLARIZER_ANGLES_DEG, Prediction


class Recovery(NamedTuple):
    """Predicted frames and their times.

    >>> import torch
    >>> from polarnet.recovery import Recovery
    >>> from polarnet.stokes import Prediction
    >>> Recovery(torch.tensor([33_333]), Prediction(torch.zeros(1, 120, 180))).prediction.dolp.shape
    torch.Size([1, 120, 180])
    """

    t_us: Int64[Tensor, " n"]
    """Ends of the windows, microseconds."""
    prediction: Prediction
    """Maps of n frames."""


def recover(
    events: Sequence[Events],
    weights: Path | None = None,
    t_us: Int64[Tensor, " m"] | None = None,
    thresholds: Sequence[float] | None = None,
    device: str = "cpu",
    binning: int | None = None,
) -> Recovery:
    """Recover DoLP, AoLP and expected errors from the events behind polarizers at 0, 45, 90 and 135 degrees.

    Windows lie between consecutive `t_us` (default: every 1/30 s from 0, which the networks are trained on), so m times
    give m - 1 frames. `weights` is a checkpoint of the DoLP network (default: the shipped one), and `thresholds` are
    the camera's contrast thresholds, ON and OFF (default: estimated). `binning` is the side of the pixel blocks that
    the network sees (default: that of its training); 2 is faster on large sensors. ValueError for another number of
    channels, for times that do not increase, and for events that end before the first window.

    >>> from polarnet.recovery import recover
    >>> from polarnet.simulation import MOTIONS, SENSORS, simulate
    >>> from skimage.data import coffee
    >>> simulation = simulate(coffee().transpose(2, 0, 1) / 255, MOTIONS["default"], SENSORS["default"], seed=1)
    >>> recover(simulation.events, t_us=simulation.t_us[:3]).prediction.dolp.shape
    torch.Size([2, 120, 180])
    """
    if len(events) != len(POLARIZER_ANGLES_DEG):
        raise ValueError(f"events: expected {len(POLARIZER_ANGLES_DEG)} channels, got {len(events)}")
    if t_us is None:
        stop_us = max((int(channel.t[-1]) for channel in events if len(channel)), default=0)
        t_us = torch.arange(0, stop_us + 1, TRAINED_WINDOW_US)
    if len(t_us) < 2 or (t_us.diff() <= 0).any():
        raise ValueError(f"t_us: expected at least two times that increase, got {t_us.tolist()[:8]}")
    windows = [EventWindow([slice_time(channel, *span) for channel in events], *span) for span in windows_of(t_us)]
    recoverer = dolp_recoverer(
        *load_network(weights or shipped_weights()), device, thresholds=thresholds, binning=binning
    )
    size = events[0].height, events[0].width
    _, prediction = recoverer.run(recoverer.start(*size), windows, recoverer.at_once(*size))
    return Recovery(t_us[1:], prediction)
