"""Write the results of `polarnet recover`: numbers (Zarr), a video, and a page.

The video shows the events of each window, DoLP, AoLP, and polarization with the reconstructed S0. Everything is written
as frames arrive, in constant memory.
"""

import shutil
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16
from torch import Tensor

from polarnet.events.representations import polarity_sums
from polarnet.events.streaming import EventWindow
from polarnet.methods.method import Recoverer, State
from polarnet.reports.maps import angle_image, dolp_image, encode_png, polarization_hsv
from polarnet.reports.player import MAX_FRAMES, TO_BYTES, TRUTH, Film, Kind, Map, write_player
from polarnet.reports.preview import PICTURES_PER_SECOND, Sheet, VideoWriter, foot_of
from polarnet.runtime.machine import usable_cores
from polarnet.stokes import Prediction
from polarnet.storage.frames import ANGLE_STEPS, FRACTION_STEPS, FRAMES_PER_CHUNK, Polarization
from polarnet.storage.groups import GrowingColumns
from polarnet.storage.true_frames import TrueFrames

OUTPUTS = ("zarr", "mp4")
VIDEO = "recovered.mp4"
MIN_FREE_BYTES = 2**26  # disk space kept free for the last frames, the video's index and the page
MAX_QUEUED = 64  # frames waiting to be written
FEW_CORES = 2  # up to this number, a live camera's network needs all cores: a writing thread delays every operation
ANGLE = "AoLP (hue), DoLP (saturation)"  # caption
RECOVERED = "recovered"  # source of the maps on the page
Maps = dict[tuple[str, Kind], UInt8[Tensor, "h w"]]
"""Maps of a frame as bytes (`polarnet.storage.panels`), by source and kind."""
ZARR_CONVENTIONS = {
    "t_us": "time of the frame, end of its window, microseconds from the first event",
    "dolp": "degree of linear polarization, divided by 65535",
    "aolp": "angle of linear polarization in radians in [0, pi), divided by 65536 and times pi",
    "log_variance": "natural logarithm of the variance that the network expects of its own DoLP",
}


class RecoveryWriter:
    """Writes frames into a folder as they arrive; as a context manager it waits for the last and closes the files.

    `outputs` is a subset of `OUTPUTS`. The folder gets recovered.zarr and recovered.mp4 (30 frames a second, whatever
    the time between them). `write_page` adds index.html and recovered.png, the video's picture of the last frame.
    `reconstruct` is a method that reconstructs intensity, for the S0 of the video; without it the video shows
    polarization at full value. `truth` is shown in the video and on the page beside each frame.
    """

    def __init__(
        self,
        folder: Path,
        outputs: Collection[str],
        reconstruct: Recoverer | None = None,
        truth: TrueFrames | None = None,
    ):
        self.folder, self.outputs = folder, outputs
        self._reconstruct, self._truth = reconstruct, truth
        self._reconstructed: State = None
        self.frames = self.stop_us = 0
        self._pictures: dict[int, Maps] = {}  # by end of the window; evenly spread over a stream of unknown length
        self._every = 1
        self._sheet: Sheet | None = None
        self._latest: tuple[EventWindow, Prediction, Float[Tensor, "h w"]] | None = None
        self._arrays = GrowingColumns(folder / "recovered.zarr", FRAMES_PER_CHUNK, False, ZARR_CONVENTIONS)
        self._video = VideoWriter(folder / VIDEO, PICTURES_PER_SECOND)
        # A second thread that computes on several cores would put those of the network to sleep between operations.
        self._thread = ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,))
        self._waiting: deque[Future] = deque()
        folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> "RecoveryWriter":
        return self

    def __exit__(self, *problem: object) -> None:
        try:
            self._wait(0)
        finally:
            self._thread.shutdown(cancel_futures=True)
            self._arrays.flush()  # after an error, too: the frames up to it are whole
            self._video.close()

    def add(self, window: EventWindow, prediction: Prediction, live: bool = False) -> None:
        """Add a frame on the CPU; returns before it is written, unless the queue is long, or `live` and cores few."""
        self._waiting.append(self._thread.submit(self._write, self.frames, window, prediction))
        self._wait(0 if live and usable_cores() <= FEW_CORES else MAX_QUEUED)
        self.frames += 1
        self.stop_us = window.stop_us

    def write_page(self, source: str, facts: Mapping[str, str], notes: Sequence[str]) -> Path:
        """Write index.html about the recovery from `source`, and recovered.png; call it after the `with` block."""
        assert self._latest is not None, "a recovery has at least one frame"
        (self.folder / "recovered.png").write_bytes(encode_png(self._labelled(*self._latest)))
        films, title = [_film(source, self._pictures)], f"DoLP from events: {source}"
        video = VIDEO if "mp4" in self.outputs else None
        return write_player(self.folder / "index.html", title, films, facts, notes, video)

    def _wait(self, most: int) -> None:
        while len(self._waiting) > most:
            self._waiting.popleft().result()

    def _write(self, number: int, window: EventWindow, prediction: Prediction) -> None:
        if shutil.disk_usage(self.folder).free < MIN_FREE_BYTES:
            raise OSError(f"{self.folder}: the disk is full; all {number} frames up to here are whole")
        if "zarr" in self.outputs:
            self._add_to_zarr(window, prediction)
        sampled = number % self._every == 0
        if not (sampled or "mp4" in self.outputs):
            return
        events = torch.stack([polarity_sums(channel) for channel in window.channels]).sum(0)
        self._latest = window, prediction, events
        if "mp4" in self.outputs:
            self._video.add(self._labelled(window, prediction, events))
        if sampled:
            true = None if self._truth is None else self._truth.at(window.stop_us)
            self._pictures[window.stop_us] = _byte_maps(events, prediction, true)
            if len(self._pictures) > 2 * MAX_FRAMES:
                self._pictures, self._every = dict([*self._pictures.items()][::2]), 2 * self._every

    def _labelled(
        self, window: EventWindow, prediction: Prediction, events: Float[Tensor, "h w"]
    ) -> UInt8[np.ndarray, "h2 w2 3"]:
        """The picture of the video: events and DoLP above polarization and AoLP, with their truth where it is known."""
        if self._sheet is None:
            self._sheet = Sheet(*prediction.dolp.shape)
        above, below = {"events": self._sheet.events(events[None])[0], "DoLP": dolp_image(prediction.dolp)}, {}
        true = None if self._truth is None else self._truth.at(window.stop_us)
        if prediction.aolp is not None:
            s0, kind = (true.s0, "true") if true else (self._s0(window, prediction), "reconstructed")
            if s0 is not None:
                below[f"polarization, {kind} S0"] = polarization_hsv(s0, prediction.dolp, prediction.aolp)
            below[ANGLE] = angle_image(prediction.dolp, prediction.aolp)
        if true:
            above["true DoLP"] = dolp_image(true.dolp)
            below[f"true {ANGLE}"] = angle_image(true.dolp, true.aolp)
        foot = foot_of((window.start_us, window.stop_us), sum(map(len, window.channels)))
        return self._sheet.picture([above, below], foot)

    def _s0(self, window: EventWindow, prediction: Prediction) -> Float[Tensor, "h w"] | None:
        """Mean of the reconstructed intensities, in [0, 1]; None if no method reconstructs them."""
        intensities = prediction.intensities
        if intensities is None and self._reconstruct is not None:
            if self._reconstructed is None:
                self._reconstructed = self._reconstruct.start(*prediction.dolp.shape)
            self._reconstructed, own = self._reconstruct.step(self._reconstructed, [window])
            intensities = None if own.intensities is None else own.intensities[0]
        return None if intensities is None else intensities.mean(0).float()

    def _add_to_zarr(self, window: EventWindow, prediction: Prediction) -> None:
        dolp = _quantised(prediction.dolp * FRACTION_STEPS)
        frame = {"t_us": np.array(window.stop_us, np.int64), "dolp": dolp}
        if prediction.aolp is not None:
            frame["aolp"] = _quantised(prediction.aolp * (ANGLE_STEPS / np.pi) % ANGLE_STEPS)
        if prediction.log_variance is not None:
            frame["log_variance"] = prediction.log_variance.numpy().astype(np.float32)
        self._arrays.add(frame)


def _quantised(steps: Tensor) -> UInt16[np.ndarray, "h w"]:
    return steps.round().clamp(0, FRACTION_STEPS).numpy().astype(np.uint16)


def _byte_maps(events: Float[Tensor, "h w"], prediction: Prediction, true: Polarization | None) -> Maps:
    """The maps of a frame and of its truth, if that is known, as bytes by source and kind."""
    values: dict[tuple[str, Kind], Tensor] = {("Events", "events"): events}
    if true is not None:
        values |= {(TRUTH, "s0"): true.s0, (TRUTH, "aolp"): true.aolp, (TRUTH, "dolp"): true.dolp}
    elif prediction.intensities is not None:
        values[RECOVERED, "s0"] = prediction.intensities[::2].float().mean(0)
    values[RECOVERED, "dolp"] = prediction.dolp
    if prediction.aolp is not None:
        values[RECOVERED, "aolp"] = prediction.aolp
    return {name: TO_BYTES[name[1]](one) for name, one in values.items()}


def _film(source: str, pictures: Mapping[int, Maps]) -> Film:
    """The film of a recovery for the page's player; the truth if every frame has it."""
    first, *others = pictures.values()
    names = [name for name in first if all(name in one for one in others)]
    maps = [Map(*name, torch.stack([one[name] for one in pictures.values()]).numpy()) for name in names]
    return Film(source, [*pictures], maps)
