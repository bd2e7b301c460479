"""The record of a method: its name, what it needs, and how it goes from window to window with its state in hand."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from polarnet.events.streaming import EventWindow
from polarnet.methods.postprocessing import PostprocessingConfig
from polarnet.methods.stokes_gain import GainConfig
from polarnet.networks.checkpoint import load_checkpoint
from polarnet.stokes import Prediction

State = Any
"""What a method remembers of the events before a window: tensors, or nothing yet."""


@dataclass(frozen=True)
class WeightsConfig:
    """Section `methods.NAME` of params.yaml for a method whose only setting is its weights."""

    weights: str | None
    """A .safetensors checkpoint of polarnet, or a file as its authors published it; null: the record says which."""

    def __post_init__(self):
        if self.weights is not None and not self.weights.strip():
            raise ValueError(f"weights: expected the path of a file or null, got {self.weights!r}")


@dataclass(frozen=True)
class Setup:
    """Everything that a method gets besides events."""

    config: Any
    """Section `methods.NAME` of params.yaml."""
    weights: Path | None
    """File of its weights; None where it needs none, or where none is configured."""
    postprocessing: PostprocessingConfig
    gain: GainConfig
    device: torch.device
    precision: str
    """Precision of networks: fp32, or bf16 autocast."""

    def __hash__(self) -> int:
        return hash((self.weights, self.device, self.precision))  # settings may be lists, which have no hash

    def autocast(self) -> torch.autocast:
        """The precision of networks, for a `with`."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bf16")


class Recoverer(NamedTuple):
    """A method with its settings and weights, ready for events. It keeps nothing: state goes in and comes out.

    state = recoverer.start(height, width)
    state, prediction = recoverer.step(state, windows)
    """

    start: Callable[[int, int], State]
    """Height and width of a channel -> the state before the first event."""
    predict: Callable[[State, Sequence[EventWindow]], tuple[State, Prediction]]
    """`step` of this method before DoLP is clamped."""
    takes_events_once: bool = False
    """Whether a window's events that an earlier window held are left out, so that windows may overlap freely."""
    network: nn.Module | None = None
    """The network that it runs; None for a filter."""

    @torch.no_grad()
    def step(self, state: State, windows: Sequence[EventWindow]) -> tuple[State, Prediction]:
        """The state after n consecutive windows, each of which begins where the one before ends, and n frames.

        Maps are n h w, on the method's device; DoLP is float32 in [0, 1]: clamped here, for every method alike.
        """
        state, prediction = self.predict(state, windows)
        return state, clamped(prediction)


@dataclass(frozen=True)
class Weights:
    """The weights that a method needs."""

    networks: tuple[str, ...]
    """Networks that a checkpoint of polarnet may hold, by their names in its JSON."""
    trained_by: str | None = None
    """Training stage whose best.safetensors is used where `methods.NAME.weights` is null; None: no stage."""
    remedy: str = ""
    """How else to get them, beside a file."""


@dataclass(frozen=True)
class Method:
    """A way from events to DoLP."""

    name: str
    """Row of the benchmark, `--method` of recover, section of `methods` in params.yaml."""
    label: str
    """Name in tables and figures."""
    colour: str
    """Colour in figures, #rrggbb, of NAME+gain too."""
    open: Callable[[Setup], Recoverer]
    """Loads what is needed. FileNotFoundError or ValueError where the weights are missing or of another network."""
    config: type | None = None
    """Class of the section `methods.NAME`; None: it has none."""
    weights: Weights | None = None
    """None: it needs none."""
    reconstructs: bool = False
    """Whether DoLP comes from reconstructed intensities, which `Prediction.intensities` then holds."""
    about: str = ""
    """Sentence of the glossary of pages. Of a row that may hold several networks, or published weights: what it stands
    for beside its network; empty where the network's own sentence says all."""
    wraps: "Method | None" = None
    """The method whose predictions `convert` turns into this one's."""
    convert: Callable[[Setup, State, Prediction], tuple[State, Prediction]] | None = None
    """State (None at the start) and the wrapped method's prediction -> state, prediction."""

    @property
    def section(self) -> str:
        """Key of its section in `methods` of params.yaml: its own name, or that of the method that it wraps."""
        return self.wraps.section if self.wraps else self.name


def weights_file(setup: Setup) -> Path:
    """The file of a method's weights; FileNotFoundError where there is none."""
    if setup.weights is None or not setup.weights.exists():
        reason = "no weights are given" if setup.weights is None else f"{setup.weights} is missing"
        raise FileNotFoundError(reason)
    return setup.weights


def why_absent(method: Method, setup: Setup) -> str | None:
    """Why a method cannot run; None where it can."""
    if method.weights is None:
        return None
    key, path = f"methods.{method.section}.weights", setup.weights
    if path is None:
        return f"no weights are given: set {key} to their file"
    if not path.exists():
        return f"{path} is not there"
    networks = method.weights.networks
    if path.suffix == ".safetensors" and (network := load_checkpoint(path)[1]["network"]) not in networks:
        reason = f"{path} holds a {network}, expected {' or '.join(networks)}: set {key} to such a file"
        return f"{reason}, or {method.weights.remedy}" if method.weights.remedy else reason
    return None


def weights_record(method: Method, setup: Setup) -> dict[str, str]:
    """File name, sha256 and network of a method's weights; FileNotFoundError or ValueError where it has none."""
    if method.weights is None:
        raise ValueError(f"{method.name} needs no weights, so there is no record of them")
    path = weights_file(setup)
    own = path.suffix == ".safetensors"
    return {
        "file": path.name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "network": load_checkpoint(path)[1]["network"] if own else method.weights.networks[0],
    }


def clamped(prediction: Prediction) -> Prediction:
    """A prediction with DoLP in [0, 1], and its maps in float32."""
    aolp, log_variance = (None if x is None else x.float() for x in (prediction.aolp, prediction.log_variance))
    return prediction._replace(dolp=prediction.dolp.float().clamp(0, 1), aolp=aolp, log_variance=log_variance)


def each_map(prediction: Prediction, change: Callable[[Tensor], Tensor]) -> Prediction:
    """A prediction with each of its maps changed alike."""
    return Prediction(*(None if field is None else change(field) for field in prediction))  # type: ignore[arg-type]
