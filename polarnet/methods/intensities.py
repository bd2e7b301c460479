"""DoLP from reconstructed intensities, and the wrapper NAME+gain, which first solves the gains of the channels."""

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.events.streaming import EventWindow
from polarnet.methods.method import Method, Recoverer, Setup, State
from polarnet.methods.stokes_gain import consistent
from polarnet.stokes import Prediction, aolp, dolp, stokes_from_intensities

GAIN = "+gain"


def from_intensities(intensities: Float[Tensor, "n c h w"]) -> Prediction:
    """DoLP and AoLP (Eq. 1-3) from the intensities of the four channels, which must share one scale.

    A single channel, of a camera without polarizers, leaves DoLP unknown (NaN).
    """
    if intensities.shape[1] == 1:
        return Prediction(torch.full_like(intensities[:, 0], torch.nan), intensities=intensities)
    stokes = stokes_from_intensities(intensities)
    return Prediction(dolp(stokes), aolp(stokes), intensities=intensities)


def with_gain(method: Method) -> Method:
    """The method NAME+gain, which scales the intensities of `method` so that I0 + I90 = I45 + I135.

    If both rows are wanted, they share one run: `convert` turns the predictions of `method` into those of NAME+gain.
    """

    def convert(setup: Setup, before: State, prediction: Prediction) -> tuple[State, Prediction]:
        intensities = prediction.intensities
        if intensities is None:
            raise ValueError(f"{method.name} reconstructs no intensities, so that it has no gains to solve")
        earlier = intensities[:0] if before is None else before
        images = torch.cat([earlier, intensities])
        solved = from_intensities(consistent(images, setup.gain, len(earlier)))
        return images[max(0, len(images) + 1 - setup.gain.window_frames) :], solved

    def open_both(setup: Setup) -> Recoverer:
        inner = method.open(setup)

        def start(height: int, width: int) -> State:
            return inner.start(height, width), None

        def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
            state, images = state
            state, prediction = inner.step(state, windows)
            images, prediction = convert(setup, images, prediction)
            return (state, images), prediction

        return Recoverer(start, predict, inner.takes_events_once, inner.network)

    return dataclasses.replace(
        method,
        name=method.name + GAIN,
        label=f"{method.label}, gains solved",
        open=open_both,
        config=None,
        wraps=method,
        convert=convert,
    )
