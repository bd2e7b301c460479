"""Every way to recover DoLP behind one signature: a recording in, a DoLP (and AoLP) frame per window out.

A method that gives intensities becomes DoLP here and nowhere else, and DoLP is clamped to [0, 1] here and nowhere else,
for every method alike. Another method is one function and one entry in `METHODS`, or in `INTENSITY_METHODS`, whose
every entry is two methods: as it is, and with the polarizers' gains solved from their redundancy.
"""

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from polarnet.baselines.complementary_filter import (
    ComplementaryFilterConfig,
    HighPassConfig,
    reconstruct_cf,
    reconstruct_highpass,
)
from polarnet.baselines.e2p import BRANCHES, E2p, decoded_aolp, interleaved
from polarnet.baselines.e2vid import E2vid
from polarnet.baselines.firenet import FireNet
from polarnet.baselines.postprocessing import PostprocessingConfig, postprocessed
from polarnet.baselines.stokes_gain import GainConfig, consistent
from polarnet.baselines.trivial import constant, oracle_mean
from polarnet.events.representations import REPRESENTATIONS, normalise_nonzero, voxel_grid
from polarnet.events.stream import Events
from polarnet.events.windows import encode_windows
from polarnet.networks.blocks import Prediction
from polarnet.networks.checkpoint import load_checkpoint, load_network, load_tensors
from polarnet.stokes import aolp, dolp, stokes_from_intensities

NEEDED: Mapping[str, tuple[str, ...]] = {
    "e2v": ("firenet", "e2vid"),
    "firenet": ("firenet",),
    "firenet_published": ("firenet",),
    "firenetplus_published": ("firenet",),
    "e2vid": ("e2vid",),
    "e2vid_published": ("e2vid",),
    "e2p": ("e2p",),
    "paper": (),
    "ours": (),
}
"""Rows that need weights, and the networks they may be of; none named: any network that recovers DoLP."""

GAIN = "+gain"


@dataclass(frozen=True)
class WeightsConfig:
    """Section `baselines.weights` of params.yaml: files of weights; what a row without any is said beside its key.

    A .safetensors is a checkpoint of polarnet's own, anything else a file as its authors published it.
    """

    e2v: str | None
    """null: what stage train_e2v left, whichever network it is."""
    firenet: str | None
    """null: what stage train_e2v left, if baselines.e2v.arch is firenet."""
    e2vid: str | None
    """null: what stage train_e2v left, if baselines.e2v.arch is e2vid."""
    e2p: str | None
    """null: what stage train_e2p left."""
    paper: str | None
    """A DoLP network to hold against the one in use, such as one trained with experiment=paper; null: none."""
    firenet_published: str | None
    """firenet_1000.pth.tar; null: none, like the next two."""
    firenetplus_published: str | None
    e2vid_published: str | None

    def __post_init__(self):
        for row, file in vars(self).items():
            if file is not None and not file.strip():
                raise ValueError(f"{row}: expected the path of a file or null, got {file!r}")


@dataclass(frozen=True)
class Recording:
    """One sequence as the methods see it, and its truth, which of all methods only `oracle_mean` looks at."""

    name: str
    scene: str
    """The source picture that it shows."""
    events: Sequence[Events]
    """Of the four polarizers; time counts from the start of the sequence."""
    t_us: Int64[Tensor, " frames"]
    """Times of the frames, one more than there are windows: window k lies between frames k and k + 1."""
    dolp: Float[Tensor, "n h w"]
    """Truth at the end of each window; so are the next two."""
    aolp: Float[Tensor, "n h w"]
    s0: Float[Tensor, "n h w"]
    valid: Bool[Tensor, "n h w"] | None = None
    """Where the truth is known, and so scored; None: everywhere."""


class Polarization(NamedTuple):
    """What a method makes of a recording, not yet clamped; AoLP in radians, None where the method has none."""

    dolp: Float[Tensor, "n h w"]
    aolp: Float[Tensor, "n h w"] | None = None
    log_variance: Float[Tensor, "n h w"] | None = None
    """Natural logarithm of the squared error of DoLP that the method expects; None where it says nothing of it."""


class Recovered(NamedTuple):
    """A method's answer, DoLP in [0, 1] (float32), and what it took."""

    dolp: Float[Tensor, "n h w"]
    aolp: Float[Tensor, "n h w"] | None
    log_variance: Float[Tensor, "n h w"] | None
    seconds: float

    @property
    def polarization(self) -> Polarization:
        """Without the time."""
        return Polarization(self.dolp, self.aolp, self.log_variance)


@dataclass(frozen=True)
class Context:
    """What methods need beside the recording. Networks are loaded when a method first asks for them."""

    train_mean: float
    """Mean DoLP of the training split."""
    cf: ComplementaryFilterConfig
    highpass: HighPassConfig
    postprocessing: PostprocessingConfig
    gain: GainConfig
    e2v_checkpoint: Path | None
    """Like the others: the file of a row's weights; `checkpoints_of` finds them. None: there is none."""
    firenet_checkpoint: Path | None
    e2vid_checkpoint: Path | None
    e2p_checkpoint: Path | None
    firenet_published_checkpoint: Path | None
    firenetplus_published_checkpoint: Path | None
    e2vid_published_checkpoint: Path | None
    paper_checkpoint: Path | None
    ours_checkpoint: Path | None
    device: torch.device
    precision: str
    """Of the networks: fp32, or bf16 autocast."""

    @cached_property
    def e2v(self) -> FireNet | E2vid:
        """The events-to-intensity network that is trained here, whichever it is."""
        path = _present(self.e2v_checkpoint)
        held = load_checkpoint(path)[1]["network"]
        network = baseline(FireNet, "firenet", path) if held == "firenet" else baseline(E2vid, "e2vid", path)
        return network.to(self.device)

    @cached_property
    def firenet(self) -> FireNet:
        """FireNet, trained here; the properties below say which networks they are as plainly."""
        return baseline(FireNet, "firenet", self.firenet_checkpoint).to(self.device)

    @cached_property
    def e2vid(self) -> E2vid:
        """E2VID, trained here."""
        return baseline(E2vid, "e2vid", self.e2vid_checkpoint).to(self.device)

    @cached_property
    def e2p(self) -> E2p:
        """E2P, trained here."""
        return baseline(E2p, "e2p", self.e2p_checkpoint).to(self.device)

    @cached_property
    def firenet_published(self) -> FireNet:
        """FireNet as its authors published it."""
        return baseline(FireNet, "firenet", self.firenet_published_checkpoint).to(self.device)

    @cached_property
    def firenetplus_published(self) -> FireNet:
        """FireNet+ as its authors published it."""
        return baseline(FireNet, "firenet", self.firenetplus_published_checkpoint).to(self.device)

    @cached_property
    def e2vid_published(self) -> E2vid:
        """E2VID as its authors published it."""
        return baseline(E2vid, "e2vid", self.e2vid_published_checkpoint).to(self.device)

    @cached_property
    def paper(self) -> tuple[nn.Module, dict[str, Any]]:
        """A second network that turns events into DoLP, and its checkpoint's metadata."""
        return dolp_checkpoint(self.paper_checkpoint, self.device)

    @cached_property
    def ours(self) -> tuple[nn.Module, dict[str, Any]]:
        """The network that turns events into DoLP, and its checkpoint's metadata."""
        return dolp_checkpoint(self.ours_checkpoint, self.device)

    def autocast(self) -> torch.autocast:
        """The precision of the networks, for a `with`."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bf16")


Network = TypeVar("Network", FireNet, E2vid, E2p)


def checkpoints_of(config: WeightsConfig, train: Path, train_e2v: Path, train_e2p: Path) -> dict[str, Path | None]:
    """The fields `<row>_checkpoint` of `Context`: the configuration's files, else what the training stages left."""
    trained = {"e2v": train_e2v, "firenet": train_e2v, "e2vid": train_e2v, "e2p": train_e2p, "ours": train}
    found = {row: folder / "best.safetensors" for row, folder in trained.items()}
    return {
        f"{row}_checkpoint": Path(file) if (file := getattr(config, row, None)) else found.get(row) for row in NEEDED
    }


def baseline(build: type[Network], kind: str, path: Path | None) -> Network:
    """A baseline's network, from a checkpoint of polarnet's own or a published file; ValueError for another network."""
    path = _present(path)
    if path.suffix != ".safetensors":
        return build.load(path)
    tensors, metadata = load_checkpoint(path)
    if metadata["network"] != kind:
        raise ValueError(f"{path} holds a {metadata['network']}, expected a {kind}")
    network = build(**metadata["config"])
    load_tensors(network, tensors, path)
    return network.eval()


def dolp_checkpoint(path: Path | None, device: torch.device) -> tuple[nn.Module, dict[str, Any]]:
    """A network that turns events into DoLP, and its checkpoint's metadata."""
    network, metadata = load_network(_present(path))
    return network.to(device, memory_format=torch.channels_last), metadata  # type: ignore[call-overload]


def _present(path: Path | None) -> Path:
    if path is None or not path.exists():
        raise FileNotFoundError("no weights are given" if path is None else f"{path} is missing")
    return path


def available(methods: Sequence[str], context: Context) -> tuple[list[str], dict[str, str]]:
    """The methods whose weights are there, in their order, and for each of the others the reason why it is left out."""
    reasons = {method: reason for method in methods if (reason := why_absent(method, context))}
    return [method for method in methods if method not in reasons], reasons


def why_absent(method: str, context: Context) -> str | None:
    """What is in the way of a method; None where nothing is."""
    row = method.removesuffix(GAIN)
    if row not in NEEDED:
        return None
    path, kinds = _checkpoint(row, context), NEEDED[row]
    if path is None:
        return f"no weights are given: set baselines.weights.{row} to their file"
    if not path.exists():
        return f"{path} is not there"
    if kinds and path.suffix == ".safetensors" and (held := load_checkpoint(path)[1]["network"]) not in kinds:
        needed = f"{path} holds a {held}, expected {' or '.join(kinds)}: set baselines.weights.{row} to such a file"
        return f"{needed}, or train one with baselines.e2v.arch={row}" if row in NEEDED["e2v"] else needed
    return None


def weights_used(methods: Sequence[str], context: Context) -> dict[str, dict[str, str]]:
    """File name, sha256 and network of the weights behind each of these methods that needs any."""
    rows = [row for method in methods if (row := method.removesuffix(GAIN)) in NEEDED]
    return {
        row: {
            "file": path.name,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
            "network": load_checkpoint(path)[1]["network"] if path.suffix == ".safetensors" else NEEDED[row][0],
        }
        for row in rows
        if (path := _checkpoint(row, context)) is not None
    }


def metadata_used(methods: Sequence[str], context: Context) -> dict[str, dict[str, Any]]:
    """What the checkpoints behind these methods say of themselves, by row; files of other authors say nothing."""
    paths = {row: _checkpoint(row, context) for method in methods if (row := method.removesuffix(GAIN)) in NEEDED}
    own = {row: path for row, path in paths.items() if path is not None and path.suffix == ".safetensors"}
    return {row: load_checkpoint(path)[1] for row, path in own.items()}


def _checkpoint(row: str, context: Context) -> Path | None:
    return getattr(context, f"{row}_checkpoint")


Method = Callable[[Recording, Context], Polarization]
IntensityMethod = Callable[[Recording, Context], Float[Tensor, "n 4 h w"]]


@torch.no_grad()
def recover(method: str, recording: Recording, context: Context) -> Recovered:
    """Run one of `METHODS`, clamp its DoLP, and take the time: from events in memory to frames in memory."""
    start = time.perf_counter()
    found = METHODS[method](recording, context)
    recovered = degree(found.dolp).cpu()
    seconds = time.perf_counter() - start
    aolp, log_variance = (None if maps is None else maps.float().cpu() for maps in (found.aolp, found.log_variance))
    return Recovered(recovered, aolp, log_variance, seconds)


def degree(dolp: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """What a method says, as a degree of polarization: in [0, 1], float32."""
    return dolp.float().clamp(0, 1)


def zeros(recording: Recording, context: Context) -> Polarization:
    """No polarization anywhere."""
    return Polarization(constant(0.0, recording.dolp))


def train_mean(recording: Recording, context: Context) -> Polarization:
    """What the training split has on average, everywhere."""
    return Polarization(constant(context.train_mean, recording.dolp))


def own_mean(recording: Recording, context: Context) -> Polarization:
    """The best of all constants for each frame, which only the truth can tell."""
    return Polarization(oracle_mean(recording.dolp, recording.valid))


def from_intensities(method: IntensityMethod) -> Method:
    """Turn intensities behind the four polarizers, on a scale common to the four, into DoLP and AoLP (Eq. 1-3)."""

    def polarization(recording: Recording, context: Context) -> Polarization:
        stokes = stokes_from_intensities(method(recording, context))
        return Polarization(dolp(stokes), aolp(stokes))

    return polarization


def with_gain(method: IntensityMethod) -> IntensityMethod:
    """Bring intensities that lack a factor each to a common scale, by I0 + I90 = I45 + I135."""

    def intensities(recording: Recording, context: Context) -> Float[Tensor, "n 4 h w"]:
        return consistent(method(recording, context), context.gain)

    return intensities


def cf_intensities(recording: Recording, context: Context) -> Float[Tensor, "n 4 h w"]:
    """The complementary filter, events only, once for each polarizer."""
    return reconstruct_cf(recording.events, recording.t_us[1:], context.cf)


def highpass_intensities(recording: Recording, context: Context) -> Float[Tensor, "n 4 h w"]:
    """The high-pass filter, once for each polarizer."""
    return reconstruct_highpass(recording.events, recording.t_us[1:], context.highpass)


def network_intensities(
    network_of: Callable[[Context], FireNet | E2vid], *, normalised: bool = True
) -> IntensityMethod:
    """An events-to-intensity network; the polarizers are four streams of one batch. As it says, not clipped."""

    def intensities(recording: Recording, context: Context) -> Float[Tensor, "n 4 h w"]:
        network, state, frames = network_of(context), None, []
        for window in _voxel_grids(recording, network.bins):
            grid = window.to(context.device)
            with context.autocast():
                intensity, state = network(normalise_nonzero(grid) if normalised else grid, state)
            frames.append(intensity.float())
        return torch.stack(frames)

    return intensities


def clipped(method: IntensityMethod) -> IntensityMethod:
    """Intensities in [0, 1]: of networks trained here, which say them on their true scale."""
    return lambda recording, context: method(recording, context).clamp(0, 1)


def published(method: IntensityMethod) -> IntensityMethod:
    """Intensities post-processed as the authors of E2VID do with theirs, in [0, 1]."""
    return lambda recording, context: postprocessed(method(recording, context), context.postprocessing)


def e2p(recording: Recording, context: Context) -> Polarization:
    """E2P, window by window, on the four channels laid out as a mosaic of twice the height and width."""
    network, state, frames = context.e2p, None, []
    for window in _voxel_grids(recording, network.bins):
        with context.autocast():
            maps, state = network(interleaved(window.to(context.device))[None], state)
        frames.append(maps[0].float())
    found = dict(zip(BRANCHES, torch.stack(frames, dim=1), strict=True))
    return Polarization(found["dolp"], decoded_aolp(found["aolp"]))


def dolp_network(network_of: Callable[[Context], tuple[nn.Module, dict[str, Any]]]) -> Method:
    """A DoLP network, window by window with its state carried on, as it would run behind a camera."""

    def polarization(recording: Recording, context: Context) -> Polarization:
        network, metadata = network_of(context)
        inputs = encode_windows(recording.events, recording.t_us, REPRESENTATIONS[metadata["representation"]])
        state: list[Tensor] | None = None
        frames: list[Prediction] = []
        for window in inputs:
            with context.autocast():
                prediction, state = network(window[None].to(context.device), state)
            frames.append(prediction)
        angles = [frame.aolp for frame in frames if frame.aolp is not None]
        variances = [frame.log_variance for frame in frames if frame.log_variance is not None]
        more = (torch.cat(maps) if maps else None for maps in (angles, variances))
        return Polarization(torch.cat([frame.dolp for frame in frames]), *more)

    return polarization


def _voxel_grids(recording: Recording, bins: int) -> Float[Tensor, "n 4 bins h w"]:
    grids = encode_windows(recording.events, recording.t_us, lambda events, window_us: voxel_grid(events, bins))
    return grids.unflatten(1, (4, bins))


INTENSITY_METHODS: dict[str, IntensityMethod] = {
    "cf": cf_intensities,
    "highpass": highpass_intensities,
    "e2v": clipped(network_intensities(lambda context: context.e2v)),
    "e2vid": clipped(network_intensities(lambda context: context.e2vid)),
    "e2vid_published": published(network_intensities(lambda context: context.e2vid_published)),
    "firenet": clipped(network_intensities(lambda context: context.firenet)),
    "firenet_published": published(network_intensities(lambda context: context.firenet_published)),
    "firenetplus_published": published(
        network_intensities(lambda context: context.firenetplus_published, normalised=False)
    ),
}

METHODS: dict[str, Method] = {
    "zeros": zeros,
    "train_mean": train_mean,
    "oracle_mean": own_mean,
    **{name: from_intensities(method) for name, method in INTENSITY_METHODS.items()},
    **{name + GAIN: from_intensities(with_gain(method)) for name, method in INTENSITY_METHODS.items()},
    "e2p": e2p,
    "paper": dolp_network(lambda context: context.paper),
    "ours": dolp_network(lambda context: context.ours),
}
