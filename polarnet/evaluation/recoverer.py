"""DoLP and AoLP window by window, as events come: every method of the benchmark as a stream.

Networks learn on windows that follow each other, 1/30 s long in the paper, and their state is to summarise all that
came before the present window. For DoLP more often than that, windows must neither be shorter (what they count would
be of another kind) nor hand the state from each to the next while they overlap (most events would count many
times). `StateHistory` keeps it right: a window begins with the state that the windows up to its own start left.
"""

import itertools
import operator
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from polarnet.baselines.complementary_filter import (
    FilterState,
    Step,
    filter_at_rest,
    step_cf,
    step_highpass,
)
from polarnet.baselines.e2p import BRANCHES, E2p, decoded_aolp, interleaved
from polarnet.baselines.e2vid import E2vid
from polarnet.baselines.firenet import FireNet
from polarnet.baselines.postprocessing import PostprocessingConfig, postprocessed
from polarnet.baselines.stokes_gain import GainConfig, last_gains
from polarnet.evaluation.methods import GAIN, NEEDED, Context, degree
from polarnet.events.representations import (
    REPRESENTATIONS,
    Encode,
    event_tensor,
    normalise_nonzero,
    voxel_grid,
)
from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import EventWindow, SlidingEventTensor
from polarnet.networks.blocks import Prediction
from polarnet.stokes import aolp, dolp, stokes_from_intensities

STATES_PER_WINDOW = 64
"""Of overlapping windows closer together than a 64th of their length, not all leave their state: memory."""

Forward = Callable[[Tensor, Any], tuple[Prediction, Any]]
"""Inputs (b c h w) of one window and the state that the window before left (None at the start) -> maps, state."""


@runtime_checkable
class Stream(Protocol):
    """A method that gets one window after the other."""

    windows: int
    """How many it has seen since the start: the first few say little, as in the benchmark (`warmup_windows`)."""

    def step(self, window: EventWindow) -> Prediction:
        """DoLP in [0, 1] and, where the method has one, AoLP in radians, at the window's end; h w."""

    def reset(self) -> None:
        """Forget everything: what comes next is the start of another recording."""


class StateHistory:
    """The states that windows left, for the windows that begin where they ended.

    A window gets the newest state whose window ended no later than it begins. Windows one after the other so have their
    state handed on. Of windows that overlap, every S-th of a length of n S, each continues the one n before it, as if n
    recoverers ran with shifted windows: no event counts twice, none is missed. What a step that does not divide the
    length leaves before the present window is missed. At most `STATES_PER_WINDOW` states a window are kept; where steps
    are finer, up to a 64th of a window is missed.
    """

    def __init__(self) -> None:
        self._left: deque[tuple[int, Any]] = deque()

    def before(self, window: EventWindow) -> Any:
        """The state to begin with; None where no window ended yet."""
        while len(self._left) > 1 and self._left[1][0] <= window.start_us:
            self._left.popleft()
        return self._left[0][1] if self._left and self._left[0][0] <= window.start_us else None

    def after(self, window: EventWindow, state: Any) -> None:
        """Keep what the window left, if the last one kept is not too near."""
        if not self._left or (window.stop_us - self._left[-1][0]) * STATES_PER_WINDOW >= window.length_us:
            self._left.append((window.stop_us, state))


class WindowRecoverer:
    """What encodes each window, runs `forward` on it and carries the state, for one stream or a batch of them."""

    def __init__(self, forward: Forward, encode: Encode, device: torch.device, precision: str):
        self.windows = 0
        self._forward, self._encode, self._device, self._precision = forward, encode, device, precision
        self._history = StateHistory()
        self._sliding: list[list[SlidingEventTensor]] = []

    def reset(self) -> None:
        """Forget everything; a batch may have another size afterwards."""
        self.windows, self._history, self._sliding = 0, StateHistory(), []

    def prepare(self, height: int, width: int, streams: int = 1) -> None:
        """Run windows without events and forget them, so that the first real one does not wait for kernels."""
        nothing = [Events.empty(height, width)] * 4
        for k in range(2):  # with and without a state
            self.step_many([EventWindow(nothing, 1000 * k, 1000 * (k + 1), [0] * 4)] * streams)
        self.reset()

    def step(self, window: EventWindow) -> Prediction:
        """DoLP in [0, 1] and, where the network has one, AoLP in radians, at a window's end; h w, on the device."""
        return each_map(self.step_many([window]), lambda batch: batch[0])

    @torch.inference_mode()
    def step_many(self, windows: Sequence[EventWindow]) -> Prediction:
        """`step` of b streams whose windows have the same times; b h w.

        ValueError where times differ, or where there are more or fewer streams than before.
        """
        spans = {(window.start_us, window.stop_us) for window in windows}
        if len(spans) != 1 or len(self._sliding) not in (0, len(windows)):
            raise ValueError(
                f"expected windows of one time and, until reset(), of {len(self._sliding) or 'any number of'} streams, "
                f"got {len(windows)} with times {sorted(spans)} us"
            )
        self._begin(windows)
        pairs = zip(windows, self._sliding, strict=True)
        inputs = torch.stack([self._inputs(window, sliding) for window, sliding in pairs])
        found = self._run(self._forward, inputs, self._history.before(windows[0]), windows[0])
        self.windows += 1
        return found

    def _begin(self, streams: Sequence[EventWindow]) -> None:
        if not self._sliding:
            self._sliding = [[SlidingEventTensor(e.height, e.width) for e in w.channels] for w in streams]

    def _run(self, forward: Forward, inputs: Tensor, state: Any, last: EventWindow) -> Prediction:
        """Maps of inputs, whose new state is that after the window `last`."""
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._precision == "bf16"):
            found, state = forward(inputs.to(self._device), state)
        self._history.after(last, state)
        return each_map(found, Tensor.float)._replace(dolp=degree(found.dolp))

    def _inputs(self, window: EventWindow, sliding: Sequence[SlidingEventTensor]) -> Float[Tensor, "c h w"]:
        if self._encode is event_tensor:
            for tensor, events, first in zip(sliding, window.channels, window.first, strict=True):
                tensor.move_to(first, events)
            return torch.stack([tensor.tensor(window.length_us) for tensor in sliding])
        images = [self._encode(events, window.length_us) for events in window.channels]
        return torch.cat([image.view(-1, *image.shape[-2:]) for image in images])


class Recoverer(WindowRecoverer):
    """A DoLP network as a stream: `Recoverer(load_network(path)).step(window)`, window after window.

    `network` is the network and its checkpoint's metadata. `precision` is fp32 or bf16 (autocast). Windows should be as
    long as those of the training; to have DoLP more often, let windows of that length overlap.
    """

    def __init__(
        self,
        network: tuple[nn.Module, Mapping[str, Any]],
        device: torch.device | str = "cpu",
        precision: str = "fp32",
    ):
        module, metadata = network
        place = torch.device(device)
        ready = module.to(place, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
        super().__init__(ready, REPRESENTATIONS[metadata["representation"]], place, precision)
        self._network = ready

    @torch.inference_mode()
    def step_on(self, windows: Sequence[EventWindow]) -> list[Prediction]:
        """`step` of windows of one stream, each of which begins where the one before ends: fewer, larger operations.

        ValueError where they do not follow each other.
        """
        if any(before.stop_us != after.start_us for before, after in itertools.pairwise(windows)):
            spans = [(window.start_us, window.stop_us) for window in windows]
            raise ValueError(f"expected windows that follow each other, got {spans} us")
        self._begin(windows[:1])
        inputs = torch.stack([self._inputs(window, self._sliding[0]) for window in windows])[:, None]
        unroll: Any = self._network.unroll
        found = self._run(unroll, inputs, self._history.before(windows[0]), windows[-1])
        self.windows += len(windows)
        return [each_map(found, operator.itemgetter((k, 0))) for k in range(len(windows))]


class FilterRecoverer:
    """A per-pixel filter as a stream. It takes each event once, when it first comes, so windows do not matter to it."""

    def __init__(self, step: Step, config: Any, gain: GainConfig | None):
        self.windows = 0
        self._step, self._config, self._gain = step, config, gain
        self._state: FilterState | None = None
        self._images: tuple[Tensor, ...] = ()

    def reset(self) -> None:
        """Forget everything."""
        self.windows, self._state, self._images = 0, None, ()

    def step(self, window: EventWindow) -> Prediction:
        """DoLP in [0, 1] and AoLP at the window's end."""
        first = window.channels[0]
        state = self._state or filter_at_rest(4, first.height, first.width, self._config)
        new = [slice_time(events, state.t_us, window.stop_us) for events in window.channels]
        image, self._state = self._step(state, new, window.stop_us, self._config)
        self.windows += 1
        found, self._images = polarization_of(image, self._images, self._gain)
        return found


def each_map(found: Prediction, change: Callable[[Tensor], Tensor]) -> Prediction:
    """What a method says, with each of its maps changed alike."""
    return Prediction(change(found.dolp), *(None if one is None else change(one) for one in found[1:]))


def polarization_of(
    image: Float[Tensor, "4 h w"], before: tuple[Tensor, ...], gain: GainConfig | None
) -> tuple[Prediction, tuple[Tensor, ...]]:
    """DoLP and AoLP of intensities, brought to a common scale by `gain` if given; the images that gains come from."""
    if gain is not None:
        before = (*before, image)[-gain.window_frames :]
        image = image * last_gains(torch.stack(before), gain).to(image)[:, None, None]
    stokes = stokes_from_intensities(image)
    return Prediction(degree(dolp(stokes)), aolp(stokes).float()), before


def intensity_forward(
    network: FireNet | E2vid, *, normalised: bool, shown: PostprocessingConfig | None, gain: GainConfig | None
) -> Forward:
    """An events-to-intensity network, the polarizers four streams of its batch; `shown`: how published ones are."""

    def forward(inputs: Tensor, state: Any) -> tuple[Prediction, Any]:
        inner, raw, images = state or (None, (), ())
        grids = inputs[0].unflatten(0, (4, network.bins))
        intensity, inner = network(normalise_nonzero(grids) if normalised else grids, inner)
        image = intensity.float()
        if shown is None:
            image = image.clamp(0, 1)
        else:
            raw = (*raw, image)[-shown.auto_hdr_frames if shown.auto_hdr else -1 :]
            image = postprocessed(torch.stack(raw), shown)[-1]
        found, images = polarization_of(image, images, gain)
        return each_map(found, lambda one: one[None]), (inner, raw, images)

    return forward


def e2p_forward(network: E2p) -> Forward:
    """E2P on the four channels laid out as a mosaic of twice the height and width."""

    def forward(inputs: Tensor, state: Any) -> tuple[Prediction, Any]:
        maps, state = network(interleaved(inputs.unflatten(1, (4, network.bins))), state)
        found = dict(zip(BRANCHES, maps.unbind(1), strict=True))
        return Prediction(found["dolp"], decoded_aolp(found["aolp"])), state

    return forward


FILTERS: dict[str, Step] = {"cf": step_cf, "highpass": step_highpass}
_POLARIZATION = ("e2p", "paper", "ours")  # networks that say DoLP themselves, and need no gain
STREAMED = (
    *(f"{row}{gain}" for row in (*FILTERS, *NEEDED) if row not in _POLARIZATION for gain in ("", GAIN)),
    *_POLARIZATION,
)
"""The methods that `stream_of` knows: all of the benchmark but the constants."""


def stream_of(method: str, context: Context) -> Stream:
    """A method of the benchmark as a stream; ValueError for one that is none.

    What it gives for windows one after the other is what `METHODS` gives for the recording.
    """
    if method not in STREAMED:
        raise ValueError(f"expected a method of {', '.join(STREAMED)}, got {method!r}")
    row = method.removesuffix(GAIN)
    gain = context.gain if method.endswith(GAIN) else None
    if row in FILTERS:
        return FilterRecoverer(FILTERS[row], getattr(context, row), gain)
    network = getattr(context, row)
    if row in ("paper", "ours"):
        return Recoverer(network, context.device, context.precision)
    if row == "e2p":
        forward = e2p_forward(network)
    else:
        shown = context.postprocessing if row.endswith("_published") else None
        forward = intensity_forward(network, normalised=row != "firenetplus_published", shown=shown, gain=gain)
    bins = network.bins
    return WindowRecoverer(forward, lambda events, _: voxel_grid(events, bins), context.device, context.precision)
