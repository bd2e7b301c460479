"""Events, frames, expected errors and timings for Rerun: a recording (.rrd), or the viewer that is running.

The viewer shows everything of one time together: open a file with `rerun FILE.rrd`.
"""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polarnet.events.representations import polarity_sums
from polarnet.events.streaming import TRAINED_WINDOW_US, EventWindow
from polarnet.reports.maps import angle_image, dolp_image, event_full_scale, event_image, intensity_image
from polarnet.stokes import Prediction
from polarnet.storage.events import EventStore
from polarnet.storage.parts import unknown_sequence
from polarnet.storage.true_frames import TrueFrame, TrueFrames, open_truth, truth_beside
from polarnet.terminal.installation import installation

VIEWER = "viewer"
"""Destination that stands for the running viewer."""
TIMELINE = "time"


class RerunLog:
    """Writes into a recording, or to the running viewer, as frames arrive.

    RuntimeError without the extra `rerun`.
    """

    def __init__(self, destination: Path, name: str):
        """`destination` is the file to write, or `VIEWER`; `name` is the title in the viewer."""
        try:
            import rerun
        except ImportError:
            raise RuntimeError(f"--rerun needs rerun-sdk: {installation('rerun')}") from None
        self._rerun: Any = rerun
        self._stream = rerun.RecordingStream(f"polarnet: {name}")
        if str(destination) == VIEWER:
            self._stream.connect_grpc()
        else:
            destination.parent.mkdir(parents=True, exist_ok=True)
            self._stream.save(str(destination))

    def __enter__(self) -> "RerunLog":
        return self

    def __exit__(self, *problem: object) -> None:
        self._stream.flush()
        self._stream.disconnect()

    def events(self, window: EventWindow) -> None:
        """Log ON minus OFF events of all channels in a window, and their number."""
        self._at(window.stop_us)
        sums = torch.stack([polarity_sums(events) for events in window.channels]).sum(0)
        self._image("events", event_image(sums, event_full_scale(sums)))
        self._number("events_per_window", sum(map(len, window.channels)))

    def prediction(self, t_us: int, prediction: Prediction, step_s: float, latency_s: float | None) -> None:
        """Log a predicted frame, its expected error (root mean square), and its timings in ms."""
        self._at(t_us)
        if not prediction.dolp.isnan().any():
            self._image("DoLP", dolp_image(prediction.dolp))
        if prediction.aolp is not None:
            self._image("AoLP", angle_image(prediction.dolp, prediction.aolp))
        if prediction.log_variance is not None:
            error = torch.exp(prediction.log_variance / 2)
            self._image("expected_error", dolp_image(error))
            self._number("expected_error", float(error.square().mean().sqrt()))
        self._number("timing/step_ms", 1000 * step_s)
        if latency_s is not None:
            self._number("timing/latency_ms", 1000 * latency_s)

    def truth(self, t_us: int, frame: TrueFrame) -> None:
        """Log a true frame."""
        self._at(t_us)
        self._image("true/S0", intensity_image(frame.s0))
        self._image("true/DoLP", dolp_image(frame.dolp))
        self._image("true/AoLP", angle_image(frame.dolp, frame.aolp))

    def _at(self, t_us: int) -> None:
        self._stream.set_time(TIMELINE, duration=1e-6 * t_us)

    def _image(self, name: str, pixels: np.ndarray) -> None:
        self._stream.log(name, self._rerun.Image(pixels))

    def _number(self, name: str, value: int | float) -> None:
        self._stream.log(name, self._rerun.Scalars(value))


def log_sequence(path: Path, sequence: str | None, destination: Path) -> None:
    """Log the events of a stored sequence (None: the only one), and its truth if it lies beside the store."""
    store = EventStore.open(path)
    name = store.sequences[0] if sequence is None and len(store.sequences) == 1 else sequence
    if name not in store.sequences:
        raise ValueError(f"{path}: {unknown_sequence(name, store.sequences)}")
    beside = truth_beside(path)
    truth = None if beside is None else open_truth(beside, name)
    with RerunLog(destination, name) as log:
        for start_us, stop_us in _spans(store.duration_us(name), truth):
            log.events(EventWindow(store.read(name, start_us, stop_us), start_us, stop_us))
            if truth is not None:
                log.truth(stop_us, truth.at(stop_us))


def _spans(duration_us: int, truth: TrueFrames | None) -> list[tuple[int, int]]:
    """Windows between true frames; without truth, of 1/30 s."""
    times = [*range(0, duration_us, TRAINED_WINDOW_US), duration_us] if truth is None else truth.t_us.tolist()
    return list(itertools.pairwise(times))
