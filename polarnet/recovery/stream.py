"""`polarnet recover`: frames of DoLP and AoLP from event-camera files or a running camera."""

import itertools
import math
import operator
import statistics
import time
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from polarnet.events.streaming import (
    SHORTEST_STEP_US,
    TRAINED_WINDOW_US,
    EventWindow,
    WindowCutter,
    WindowRule,
    join_windows,
)
from polarnet.methods import METHODS
from polarnet.methods.method import Method, Recoverer, Setup, each_map, weights_record, why_absent
from polarnet.methods.overlap import advance, begin, equal_parts, warm_up
from polarnet.metrics.similarity import frame_scores
from polarnet.networks.weights import shipped_weights
from polarnet.recordings.ahead import Ahead
from polarnet.recordings.arrangements import Input, Piece
from polarnet.recovery.writer import RecoveryWriter
from polarnet.runtime.machine import tune
from polarnet.stokes import Prediction
from polarnet.storage.true_frames import TrueFrames
from polarnet.terminal.progress import PATIENCE_S, ProgressBar, said_after

BAR = "{desc}: {n:.2f} s [{elapsed}{postfix}]"
NICE = 10  # of the reading thread: those of a network wait for each other, so it slows down most where one gives way
PIECES_AHEAD = 2  # of a file, of a million events each
MAX_LATENCY_S = 0.15  # from the arrival of a window's last event to its frame, where that can be reached
MAX_BACKLOG_US = 1_000_000  # no more is read while windows of this time wait, as where a file comes through a pipe
MAX_LOAD = 0.8  # share of the time that work on a camera's windows may take; above it no delay is ever made up for
MEASURED = 9  # latest measurements of that work whose median counts, so that one delay does not
MAX_GAP = 0.01  # between the end of a window and its true frame, as a fraction of the window
KEEP_UP = "Larger blocks of pixels (--binning), fewer events or a filter (--method highpass) take less time."
SCORES = {
    "mse": "MSE {:.4f}",
    "psnr": "PSNR {:.2f} dB",
    "ssim": "SSIM {:.3f}",
    "corr": "correlation {:.3f}",
    "aolp_deg": "AoLP error {:.1f} degrees",
    "oracle_mse": "MSE of the true mean of each frame alone {:.4f}",
}


class Frame(NamedTuple):
    """Prediction at the end of a window, on the CPU, with its timing."""

    window: EventWindow
    prediction: Prediction
    step_s: float
    """Time from the window's events in memory to the frame in memory; for a batch of windows, an equal share."""
    latency_s: float
    """Time from the arrival of the window's last event to the frame in memory."""


def open_method(
    method: Method, setup: Setup, weights: Path | None = None, settings: Mapping[str, Any] = {}
) -> tuple[Recoverer, str]:
    """Open a method with the user's weights (None: the shipped ones, else those of the setup) and describe it in words.

    `settings` are values of its section by key; None leaves a value as it is. A ValueError or FileNotFoundError says
    what is missing.
    """
    tune()
    if setup.frames is not None and not method.takes_frames:
        framed = ", ".join(name for name, one in METHODS.items() if one.takes_frames)
        raise ValueError(f"--frames is for --method {framed}, {method.name} does not use them")
    for option, value in ((option, value) for option, value in settings.items() if value is not None):
        if not hasattr(setup.config, option):
            raise ValueError(f"--{option} is for the DoLP network, {method.name} does not use it")
        setup = replace(setup, config=replace(setup.config, **{option: value}))
    if not method.networks:
        if weights is not None:
            raise ValueError(f"--weights: {method.name} has no weights; leave it out")
        return method.open(setup), method.name
    weights = weights or (shipped_weights() if method.shipped else setup.weights)
    setup = replace(setup, weights=weights)
    if reason := why_absent(method, setup):
        raise ValueError(f"--method {method.name}: {reason}; or name the file with --weights")
    recoverer = method.open(setup)
    whole = ", over the whole recording (--method ours: only the past)" if recoverer.between else ""
    if setup.frames is not None:
        whole += f", with {len(setup.frames.t_us)} frames of the camera"
    return recoverer, f"network {weights_record(method, setup)['network']} ({setup.precision}), {weights}{whole}"


def frames_of(source: Input, rule: WindowRule, recoverer: Recoverer) -> Iterator[Frame]:
    """Yield a frame for each window, of live input as soon as the window's last event has arrived.

    If the rule has a step and the method has frames between the ends of its windows, windows follow each other, and
    each is cut into equal parts of about that step, with a frame at the end of each part.

    Another thread reads a file ahead. Windows that are already available, such as those of a file, are processed in
    runs of up to `Recoverer.at_once` windows, overlapping ones one by one. If a live source does not wait and the
    processor is too slow for it, the windows that have arrived are joined to one. ValueError if no window is complete.
    """
    if min(source.height, source.width) < 2:  # the shipped network's DoLP of one row is not finite
        raise ValueError(
            f"expected a sensor of at least 2x2 pixels behind each polarizer, got {source.height}x{source.width}"
        )
    with said_after(PATIENCE_S, "preparing the network; the first run on a machine also compiles its kernels"):
        warm_up(recoverer, source.height, source.width, source.channels)
    part_us = rule.step_us if recoverer.between else None
    windows_of = replace(rule, step_us=None) if part_us else rule
    cutter = WindowCutter(windows_of, source.height, source.width, source.channels)
    history = begin(recoverer, source.height, source.width)
    follow = windows_of.step_us in (None, windows_of.length_us)
    most = recoverer.at_once(source.height, source.width) if follow else 1
    arrived: deque[float] = deque()  # when the last events of the windows that have no frame yet came
    until_us = number = 0

    def windows(pieces: Iterable[Piece]) -> Iterator[EventWindow]:
        nonlocal until_us
        for piece in pieces:
            until_us = piece.until_us
            for window in cutter.add(piece.channels, until_us):
                arrived.append(piece.read_at)
                yield window

    def runs() -> Iterator[list[EventWindow]]:
        with Ahead(source.pieces, PIECES_AHEAD, NICE) as ahead:
            every = windows(ahead)
            yield from iter(lambda: list(itertools.islice(every, most)), [])

    for run in _live_runs(source, windows, arrived, most) if source.live else runs():
        start = time.perf_counter()
        history, prediction = advance(recoverer, history, run)
        maps = each_map(prediction, Tensor.cpu)
        done = time.perf_counter()
        for k, window in enumerate(run):
            came = [arrived.popleft() for _ in range(window.joined)][-1]
            parts, of_parts = [window], each_map(maps, operator.itemgetter(slice(k, k + 1)))
            if part_us and recoverer.between:
                parts = equal_parts(window, part_us)
                of_parts = recoverer.between(history[-1][1], np.array([part.stop_us for part in parts]))
            for n, part in enumerate(parts):
                frame = each_map(of_parts, operator.itemgetter(n))
                _check_finite(frame, part)
                number += 1
                yield Frame(part, frame, (done - start) / len(run) / len(parts), done - came)
    if not number:
        raise ValueError(_too_short(source, rule, until_us))


def _live_runs(
    source: Input, windows: Callable[[Iterable[Piece]], Iterator[EventWindow]], arrived: Sequence[float], most: int
) -> Iterator[list[EventWindow]]:
    """Yield runs of the windows that are there, joined to one if the source does not wait and they would be late.

    `windows` cuts pieces. `arrived` holds the time when the last event of each window without a frame came. All that
    has arrived is read before the next run, in this thread: another would compete with the network for the processor,
    and fall behind further and further where others load it as well.
    """
    pieces = iter(source.pieces)
    waiting: list[EventWindow] = []
    work_s: deque[float] = deque(maxlen=MEASURED)  # of a window: its step, and its writing if that is waited for
    end: Exception | None = None
    while True:
        while end is None and (
            not waiting or (source.unread() and waiting[-1].stop_us - waiting[0].stop_us < MAX_BACKLOG_US)
        ):
            try:
                waiting += windows([next(pieces)])
            except Exception as error:  # the windows before it come first
                end = error
        if not waiting:
            assert end is not None, "reading ends with windows, or with an exception"
            if isinstance(end, StopIteration):
                return
            raise end
        measured = len(work_s) > 1
        if len(waiting) > 1 and not source.waits and measured:
            usual_s, between_us = statistics.median_low(work_s), waiting[1].stop_us - waiting[0].stop_us
            late = time.perf_counter() - arrived[0] + len(waiting) * usual_s > MAX_LATENCY_S
            if late and usual_s > MAX_LOAD * between_us * 1e-6:
                waiting = [join_windows(waiting)]
        number = most if source.waits or measured else 1
        run, waiting = waiting[:number], waiting[number:]
        start = time.perf_counter()
        yield run
        work_s.append((time.perf_counter() - start) / len(run))


def _check_finite(frame: Prediction, window: EventWindow) -> None:
    """ValueError for a DoLP with NaN or infinity."""
    if not frame.dolp.isfinite().all():
        raise ValueError(
            f"the DoLP of the window from {window.start_us} to {window.stop_us} us is not finite: the weights or the "
            "thresholds are no working ones; the frames before it are whole"
        )


def recover(
    source: Input, rule: WindowRule, words: str, writer: RecoveryWriter, frames: Iterable[Frame]
) -> dict[str, str]:
    """Write all frames of the method that `words` describe; returns facts for the page and the terminal."""
    step_ms, latency_ms = array("d"), array("d")  # 16 bytes a frame, because a camera may run for days
    last_us, joined, started = 0, (0, 0), time.perf_counter()
    with writer, ProgressBar(desc="recover", unit_scale=1e-6, bar_format=BAR) as bar:
        for frame in frames:
            writer.add(frame.window, frame.prediction, source.live)
            if frame.window.joined > 1:
                joined = joined[0] + frame.window.joined, joined[1] + 1
            step_ms.append(1000 * frame.step_s)
            latency_ms.append(1000 * frame.latency_s)
            bar.update(frame.window.stop_us - last_us)
            last_us = frame.window.stop_us
            more = {"latency": f"{latency_ms[-1]:.1f} ms"} if source.live else source.shares_read()
            if any(joined):
                more["joined"] = f"{joined[0]} windows"
            bar.set_postfix(frames=len(step_ms), step=f"{step_ms[-1]:.1f} ms", refresh=False, **more)
    run_s, stream_s = time.perf_counter() - started, last_us * 1e-6
    step = "one after the other" if rule.step_us is None else f"one every {rule.step_us / 1000:g} ms"
    facts = {
        "input": source.name,
        "size": f"{source.height} x {source.width} px",
        "method": words,
        "windows": f"of {rule.length_us / 1000:g} ms, {step}",
        "frames": f"{len(step_ms):,} of {stream_s:.3f} s",
        "step": f"{statistics.median(step_ms):.2f} ms (median)",
    }
    if not source.live:
        return facts | {"time": f"{run_s:.2f} s, {stream_s / run_s:.2f} times as fast as real time"}
    most_ms = sorted(latency_ms)[int(0.95 * (len(latency_ms) - 1))]
    facts["latency"] = f"{statistics.median(latency_ms):.1f} ms (median), 95 % within {most_ms:.1f} ms"
    if any(joined):
        facts["joined"] = f"{joined[0]:,} windows to {joined[1]:,} frames: the processor did not keep up. {KEEP_UP}"
    return facts


def _too_short(source: Input, rule: WindowRule, duration_us: int) -> str:
    """Error message for an input shorter than one window, with advice."""
    lasts = (
        f"{source.name} lasts {duration_us / 1000:g} ms, less than one window of {rule.length_us / 1000:g} ms: record "
        f"for longer"
    )
    if source.live or duration_us < SHORTEST_STEP_US:
        return lasts
    if duration_us < TRAINED_WINDOW_US:
        return f"{lasts}, or give a filter, --method highpass --window {duration_us}us"
    return f"{lasts}, or give --window {TRAINED_WINDOW_US / 1000:g}ms"


class TruthScores:
    """Scores of the frames that have a true frame at the end of their window, as in the benchmark."""

    def __init__(self, truth: TrueFrames):
        self._truth = truth
        self._scores: list[dict[str, float]] = []
        self._unmatched = 0

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames, scored."""
        for frame in frames:
            if self._truth.has(frame.window.stop_us, MAX_GAP * frame.window.length_us):
                true = self._truth.at(frame.window.stop_us)
                batch = each_map(frame.prediction, operator.itemgetter(None))
                valid = None if true.valid is None else true.valid[None]
                scores = frame_scores(batch, true.dolp[None], true.aolp[None], valid)
                self._scores.append({name: float(values) for name, values in scores.items()})
            else:
                self._unmatched += 1
            yield frame

    def sentence(self, skipped: int) -> str:
        """Means after the first `skipped` scored frames, in words; ValueError if none is left."""
        scores = self._scores[skipped:]
        if not scores:
            raise ValueError(
                f"--truth: expected more than {skipped} frames with a true frame at the end of their window, got "
                f"{len(self._scores)} of {len(self._scores) + self._unmatched}; leave out --window, or record "
                f"for longer"
            )
        means = {name: math.fsum(one[name] for one in scores) / len(scores) for name in scores[0]}
        words = ", ".join(SCORES[name].format(value) for name, value in means.items())
        rest = f", {self._unmatched} frames without a true frame" if self._unmatched else ""
        return f"{words} ({len(scores)} frames after the first {skipped}{rest})"
