"""Types of a method: its record (`Method`), its inputs (`Setup`) and its steps from window to window (`Recoverer`)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Int64
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt
from torch import Tensor, nn

from polarnet.events.rotation import Rotation
from polarnet.events.streaming import EventWindow
from polarnet.methods.registration import RegistrationConfig
from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.runtime.files import sha256
from polarnet.runtime.sections import section
from polarnet.stokes import Prediction, StokesFrames

PIXELS_AT_ONCE = 4 * 120 * 180  # total over the windows that a method processes at once; bounds the memory of a network

State = Any
"""State of a method before a window: tensors, or None at the start."""


@section
class GainConfig:
    """Section `methods.gain` of params.yaml: the gains of NAME+gain."""

    window_frames: PositiveInt
    """Number of frames that determine the gains of a frame: the frame and those before it."""
    rounds: NonNegativeInt
    """Number of reweighting rounds by how well pixels fit; 0: equal weights."""
    pixels: Annotated[int, Field(ge=4)]
    """Maximum number of pixels used from these frames, evenly spread."""
    smallest: Annotated[float, Field(gt=0, le=1)]
    """Lower bound of a gain, as a fraction of the gain that makes all four channels equally bright."""
    pull: NonNegativeFloat
    """Regularisation towards equal brightness, relative to the pixels' mean square, for poorly determined gains."""


@dataclass(frozen=True)
class Setup:
    """Inputs of a method besides events."""

    config: Any
    """Section `methods.NAME` of params.yaml; None for a method without settings."""
    weights: Path | None
    """Weights file; None if the method needs none or none is configured."""
    gain: GainConfig
    registration: RegistrationConfig
    device: torch.device
    precision: str
    """Precision of networks: fp32, or bf16 autocast."""
    rotation: Rotation | None
    """Angle of the polarizer over time, for methods of one camera behind a rotating polarizer."""
    frames: StokesFrames | None = None
    """The camera's own frames, by the clock of the windows, for a method that takes them (`Method.takes_frames`)."""

    def __hash__(self) -> int:
        return hash((self.weights, self.device, self.precision))  # settings may be lists, which have no hash


def windows_at_once(height: int, width: int) -> int:
    """Number of windows of this size in pixels that a method processes at once."""
    return max(1, PIXELS_AT_ONCE // (height * width))


class Recoverer(NamedTuple):
    """A method with its settings and weights, ready for events. It is stateless: the caller passes the state.

    state = recoverer.start(height, width)
    state, prediction = recoverer.step(state, windows)
    """

    start: Callable[[int, int], State]
    """Height and width of a channel -> the state before the first event."""
    predict: Callable[[State, Sequence[EventWindow]], tuple[State, Prediction]]
    """Same as `step`, but DoLP is not clamped."""
    takes_events_once: bool = False
    """Whether the method skips events that an earlier window held, so that windows may overlap freely."""
    network: nn.Module | None = None
    """The method's network; None for a filter."""
    at_once: Callable[[int, int], int] = windows_at_once
    """Height and width of a channel -> number of windows of a run (`step`), if so many are known already."""

    between: Callable[[State, Int64[np.ndarray, " n"]], Prediction] | None = None
    """State after a run and n times within its windows, in microseconds -> the maps at these times. The frames of such
    a method also depend on the later windows of their run, which should be as long as `at_once` says. None if a method
    has frames at the ends of its windows alone: windows must overlap for a higher rate."""

    @torch.no_grad()
    def step(self, state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        """State and prediction after n windows, each of which starts at the end of the previous one.

        Maps are n h w. DoLP is float32, clamped to [0, 1] for all methods.
        """
        state, prediction = self.predict(state, windows)
        aolp, log_variance = (None if x is None else x.float() for x in (prediction.aolp, prediction.log_variance))
        dolp = prediction.dolp.float().clamp(0, 1)
        return state, prediction._replace(dolp=dolp, aolp=aolp, log_variance=log_variance)

    def run(self, state: State, windows: Sequence[EventWindow], at_once: int) -> tuple[State, Prediction]:
        """`step` over `at_once` windows at a time; maps of all windows, on the CPU."""
        parts = []
        for first in range(0, len(windows), at_once):
            state, part = self.step(state, windows[first : first + at_once])
            parts.append(each_map(part, Tensor.cpu))
        return state, joined(parts)


def network_recoverer(
    network: Any,
    device: torch.device,
    precision: str,
    encode: Callable[[EventWindow], Tensor],
    prediction_of: Callable[[Any], Prediction],
) -> Recoverer:
    """Run a recurrent network on encoded windows; `prediction_of` takes the outputs of n windows (`unroll`)."""

    def predict(state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        inputs = torch.stack([encode(window) for window in windows]).to(device)
        with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
            outputs, state = network.unroll(inputs, state)
        return state, prediction_of(outputs)

    return Recoverer(lambda height, width: None, predict, network=network)


@dataclass(frozen=True)
class Method:
    """Record of a way from events to DoLP."""

    name: str
    """Key of the method: row of the benchmark, `--method` of recover."""
    label: str
    """Name in tables and figures."""
    colour: str
    """Colour in figures, #rrggbb, shared by NAME+gain."""
    open: Callable[[Setup], Recoverer]
    """Load the method. FileNotFoundError or ValueError if the weights are missing or of another network."""
    config: type | None = None
    """Class of the section `methods.NAME`; None: no section."""
    networks: tuple[str, ...] = ()
    """Names of the networks that its weights, a checkpoint of polarnet, may hold; empty: it needs no weights."""
    shipped: bool = False
    """Whether the package carries weights, which `polarnet recover` uses if it is given none."""
    rotating: bool = False
    """Whether the method needs the events of one camera behind a rotating polarizer instead of four channels."""
    takes_frames: bool = False
    """Whether the method uses the camera's own frames where there are some (`Setup.frames`)."""
    reconstructs: bool = False
    """Whether DoLP is computed from reconstructed intensities, held by `Prediction.intensities`."""
    about: str = ""
    """Glossary sentence of the HTML pages. For a row with several possible networks or published weights, it states
    the difference from the network's own sentence; empty if that sentence suffices."""
    wraps: "Method | None" = None
    """Method whose section and weights this one uses."""

    @property
    def section(self) -> str:
        """Name of the method, or of the method it wraps, under which settings and weights are found."""
        return self.wraps.section if self.wraps else self.name

    @property
    def settings(self) -> str | None:
        """Section of params.yaml that the method reads; None if it reads none."""
        if self.wraps is not None:
            return "methods"  # the section of the wrapped method and `methods.gain`
        return None if self.config is None else f"methods.{self.name}"


def weights_file(setup: Setup) -> Path:
    """Path of a method's weights; FileNotFoundError if there is no file."""
    if setup.weights is None or not setup.weights.exists():
        raise FileNotFoundError("no weights are given" if setup.weights is None else f"{setup.weights} is missing")
    return setup.weights


def why_absent(method: Method, setup: Setup) -> str | None:
    """Reason why a method cannot run; None if it can."""
    if not method.networks:
        return None
    key, path = f"rows.{method.name}.needs", setup.weights
    if path is None:
        return f"no weights are given: add the row to section `rows` of params.yaml, with their file as {key}"
    if not path.exists():
        return f"{path} is not there"
    network = weights_record(method, setup)["network"]
    if network in method.networks:
        return None
    return f"{path} holds a {network}, expected {' or '.join(method.networks)}: set {key} to such a file"


def weights_record(method: Method, setup: Setup) -> dict[str, str]:
    """File name, sha256 and network of the weights of a method that needs some; FileNotFoundError without a file."""
    path = weights_file(setup)
    network = load_checkpoint(path)[1]["network"] if path.suffix == ".safetensors" else method.networks[0]
    return {"file": path.name, "sha256": sha256(path), "network": network}


def each_map(prediction: Prediction, change: Callable[[Tensor], Tensor]) -> Prediction:
    """Apply `change` to every map of a prediction."""
    return Prediction(*(None if field is None else change(field) for field in prediction))  # type: ignore[arg-type]


def joined(predictions: Sequence[Prediction], join: Callable[..., Tensor] = torch.cat) -> Prediction:
    """Join the maps of several predictions, along their first axis or by `join`."""
    fields = zip(*predictions, strict=True)
    return Prediction(*(None if maps[0] is None else join(maps) for maps in fields))  # type: ignore[arg-type]
