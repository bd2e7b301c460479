"""`polarnet recover`: frames of DoLP and AoLP from event-camera files or a running camera."""

import itertools
import operator
import statistics
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from polarnet.events.rotation import Rotation
from polarnet.events.streaming import SHORTEST_STEP_US, TRAINED_WINDOW_US, EventWindow, WindowCutter, WindowRule
from polarnet.methods import METHODS
from polarnet.methods.method import Method, Recoverer, Setup, each_map, weights_record, why_absent
from polarnet.methods.overlap import advance, begin, warm_up
from polarnet.networks.weights import shipped_weights
from polarnet.recordings.live import Piece, live_lines
from polarnet.recovery.writer import RecoveryWriter
from polarnet.runtime.machine import precision_on, tune
from polarnet.stokes import Prediction
from polarnet.storage.events import EventStore
from polarnet.terminal.progress import ProgressBar

BAR = "{l_bar}{bar}| {n:.2f}/{total:.2f} s [{elapsed}<{remaining}{postfix}]"
LIVE_BAR = "{desc}: {n:.2f} s [{elapsed}{postfix}]"


class Input(NamedTuple):
    """Events of channels of equal size, read whole or piece by piece."""

    name: str
    height: int
    width: int
    pieces: Iterable[Piece]
    duration_us: int | None
    """None for live input, whose duration is unknown."""
    channels: int = 4
    """4, or 1 for a camera behind a rotating polarizer or none."""
    left_out: Mapping[str, int] | None = None
    """Unusable and late lines of live input by kind, counted while `pieces` are read; None for files."""


class Frame(NamedTuple):
    """Prediction at the end of a window, on the CPU, with its timing."""

    window: EventWindow
    prediction: Prediction
    step_s: float
    """Time from the window's events in memory to the frame in memory; for a batch of windows, an equal share."""
    latency_s: float
    """Time from the arrival of the window's last event to the frame in memory."""


@dataclass(frozen=True)
class Summary:
    """Number of frames and timing of one run."""

    frames: int
    stream_s: float
    """Time in the recording at the end of the last window."""
    run_s: float
    step_ms: float
    """Median of `Frame.step_s`, in ms."""
    latency_ms: float | None
    """Median of `Frame.latency_s`, in ms; None if all events were available from the start."""
    latency_ms_95: float | None
    """95th percentile of the latency, in ms; None as for `latency_ms`."""

    @property
    def realtime_factor(self) -> float:
        """Seconds of recording processed per second of computation."""
        return self.stream_s / self.run_s


@dataclass(frozen=True)
class ChosenMethod:
    """Method and its settings, as the user gives them."""

    name: str
    weights: Path | None = None
    """None: the shipped weights, else those of the method's section."""
    precision: str = "auto"
    """Number format of a network: fp32, bf16, or auto, which selects bf16 if the device has units for it."""
    thresholds: Sequence[float] | None = None
    """Contrast thresholds of the camera, ON and OFF; None: those of the method's section."""
    binning: int | None = None
    """Side in pixels of the blocks that the network sees; None: that of the method's section."""
    rotation: Rotation | None = None
    """Angle of the rotating polarizer before the camera, by the clock of the events."""


def open_method(chosen: ChosenMethod, setup_of: Callable[[Method], Setup]) -> tuple[Recoverer, str]:
    """Open a method with the inputs of `setup_of` and the user's changes, and describe it in words.

    A ValueError or FileNotFoundError says what is missing.
    """
    tune()
    if chosen.name not in METHODS:
        raise ValueError(f"--method: expected a method of {', '.join(METHODS)}, got {chosen.name!r}")
    method = METHODS[chosen.name]
    setup = setup_of(method)
    setup = replace(setup, precision=precision_on(setup.device, chosen.precision), rotation=chosen.rotation)
    for option, value in (("thresholds", chosen.thresholds), ("binning", chosen.binning)):
        if value is not None and not hasattr(setup.config, option):
            raise ValueError(f"--{option} is for the DoLP network, {method.name} does not use it")
        if value is not None:
            setup = replace(setup, config=replace(setup.config, **{option: value}))
    if method.weights is None:
        if chosen.weights is not None:
            raise ValueError(f"--weights: {method.name} has no weights; leave it out")
        turns = f", {setup.rotation.rate_hz:g} turns/s" if setup.rotation else ""
        return method.open(setup), f"{method.name}{turns}"
    weights = chosen.weights or (shipped_weights() if method.weights.shipped else setup.weights)
    setup = replace(setup, weights=weights)
    if reason := why_absent(method, setup):
        raise ValueError(f"--method {method.name}: {reason}")
    return method.open(setup), f"network {weights_record(method, setup)['network']} ({setup.precision}), {weights}"


def frames_of(source: Input, rule: WindowRule, recoverer: Recoverer, at_once: int | None = None) -> Iterator[Frame]:
    """Yield a frame for each window as soon as the window's last event has arrived.

    Windows that are already available, such as those of a file, are processed in runs of up to `at_once` windows
    (default: `Recoverer.at_once`).
    """
    warm_up(recoverer, source.height, source.width, source.channels)
    cutter = WindowCutter(rule, source.height, source.width, source.channels)
    history = begin(recoverer, source.height, source.width)
    most = at_once or recoverer.at_once(source.height, source.width)
    for piece in source.pieces:
        for windows in runs_of(cutter.add(piece.channels, piece.until_us), most):
            start = time.perf_counter()
            history, prediction = advance(recoverer, history, windows)
            maps = each_map(prediction, Tensor.cpu)
            done = time.perf_counter()
            for k, window in enumerate(windows):
                frame = each_map(maps, operator.itemgetter(k))
                yield Frame(window, frame, (done - start) / len(windows), done - piece.read_at)


def runs_of(windows: Iterable[EventWindow], most: int) -> Iterator[list[EventWindow]]:
    """Group adjacent windows, which neither overlap nor leave gaps, into batches of up to `most`."""
    run: list[EventWindow] = []
    for window in windows:
        if run and (len(run) == most or run[-1].stop_us != window.start_us):
            yield run
            run = []
        run.append(window)
    if run:
        yield run


def recover(
    source: Input,
    rule: WindowRule,
    recoverer: Recoverer,
    writer: RecoveryWriter,
    frames: Iterable[Frame] | None = None,
) -> Summary:
    """Write all `frames` (default: `frames_of`), with a progress bar.

    ValueError if the input is shorter than one window.
    """
    live = source.duration_us is None
    steps, latencies = array("d"), array("d")  # 16 bytes a frame, because a camera may run for days
    last_us, started = 0, time.perf_counter()
    with (
        writer,
        ProgressBar(
            total=source.duration_us, desc="recover", unit_scale=1e-6, bar_format=LIVE_BAR if live else BAR
        ) as bar,
    ):
        for frame in frames or frames_of(source, rule, recoverer):
            writer.add(frame.window, frame.prediction, live)
            steps.append(frame.step_s)
            latencies.append(frame.latency_s)
            bar.update(frame.window.stop_us - last_us)
            last_us = frame.window.stop_us
            latency = {"latency": f"{1000 * frame.latency_s:.1f} ms"} if live else {}
            bar.set_postfix(frames=len(steps), step=f"{1000 * frame.step_s:.1f} ms", refresh=False, **latency)
    if not steps:
        raise ValueError(_too_short(source, rule))
    return Summary(
        len(steps),
        last_us * 1e-6,
        time.perf_counter() - started,
        1000 * statistics.median(steps),
        1000 * statistics.median(latencies) if live else None,
        1000 * sorted(latencies)[int(0.95 * (len(latencies) - 1))] if live else None,
    )


def _too_short(source: Input, rule: WindowRule) -> str:
    """Error message for an input shorter than one window, with advice."""
    if rule.length_us is None:
        return f"{source.name} ends before {rule.events:,} events, one window: record for longer, or give fewer events"
    length = f"one window of {rule.length_us / 1000:g} ms"
    if source.duration_us is None:
        return f"{source.name} ended before {length} was full: record for longer"
    lasts = f"{source.name} lasts {source.duration_us / 1000:g} ms, less than {length}: record for longer"
    if source.duration_us >= TRAINED_WINDOW_US:
        return f"{lasts}, or give --window {TRAINED_WINDOW_US / 1000:g}ms"
    if source.duration_us >= SHORTEST_STEP_US:
        return (
            f"{lasts}. Networks need windows of {TRAINED_WINDOW_US / 1000:g} ms, filters do not: "
            f"--method highpass --window {source.duration_us}us"
        )
    return lasts


def facts_of(source: Input, rule: WindowRule, words: str, summary: Summary) -> dict[str, str]:
    """Facts about a run for the HTML page and the terminal."""
    length = f"{rule.length_us / 1000:g} ms" if rule.length_us is not None else f"{rule.events:,} events"
    step = "one after the other" if rule.step_us is None else f"one every {rule.step_us / 1000:g} ms"
    facts = {
        "input": source.name,
        "size": f"{source.height} x {source.width} px",
        "method": words,
        "windows": f"of {length}, {step}",
        "frames": f"{summary.frames:,} of {summary.stream_s:.3f} s",
        "step": f"{summary.step_ms:.2f} ms (median)",
    }
    if summary.latency_ms is None:
        return facts | {"time": f"{summary.run_s:.2f} s, {summary.realtime_factor:.2f} times as fast as real time"}
    return facts | {"latency": f"{summary.latency_ms:.1f} ms (median), 95 % within {summary.latency_ms_95:.1f} ms"}


def replay(store: EventStore, sequence: str, speed: float, write: Callable[[bytes], object]) -> None:
    """Write a sequence in the line format of `LiveLines`, at `speed` times the original pace."""
    head, times, lines = live_lines(store.read(sequence))
    write(head)
    ends = [0, *itertools.accumulate(map(len, lines.splitlines(keepends=True)))]
    started, sent = time.perf_counter(), 0
    while sent < len(times):
        due_us = int((time.perf_counter() - started) * 1e6 * speed)
        come = int(times.searchsorted(due_us, side="right"))
        if come > sent:
            asked = time.perf_counter()
            write(lines[ends[sent] : ends[come]])
            started += time.perf_counter() - asked  # time spent waiting for the reader does not count
            sent = come
        else:
            time.sleep(0.001)
