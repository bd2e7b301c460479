"""Files of `polarnet simulate`: events in several formats, true frames, and a preview, from a simulation in pieces."""

import shutil
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32
from torch import Tensor

from polarnet import stokes
from polarnet.cli.spool import EventSpool
from polarnet.clips.video import Piece
from polarnet.events.mosaic import join_mosaic
from polarnet.events.stream import Events
from polarnet.reports.maps import encode_png
from polarnet.reports.preview import write_true_video
from polarnet.simulation.camera import Camera
from polarnet.simulation.moving_sensor import leave_sensors
from polarnet.storage.events import MAX_DURATION_US, EventStore
from polarnet.storage.exchange import FORMS
from polarnet.storage.frames import CONVENTIONS, FRAMES_PER_CHUNK, quantise_angle, quantise_fraction
from polarnet.storage.groups import GrowingColumns
from polarnet.storage.true_frames import APPENDED, open_truth
from polarnet.terminal.progress import ProgressBar

STORE = "store"
FORMATS = (STORE, *FORMS)
EVENTS, TRUTH, VIDEO, PICTURE, SPOOL = "events.zarr", APPENDED, "preview.mp4", "preview.png", "spool"
TRUTH_CONVENTIONS = {
    "t_us": CONVENTIONS["t_us"],
    "s0": "S0 = I0 + I90: value / 65535",
    "dolp": CONVENTIONS["dolp"],
    "aolp": CONVENTIONS["aolp"],
}


class Outputs(NamedTuple):
    """Files to write."""

    formats: Sequence[str]
    """Some of `FORMATS`."""
    video_rate_hz: float | None
    """Pictures a second of the preview; None: no preview."""
    gamma: float
    """Gamma of S0 in the preview."""


class Written(NamedTuple):
    """Result of a simulation."""

    duration_us: int
    frames: int
    """Number of true frames."""
    height: int
    """Rows of a channel."""
    width: int
    events: tuple[int, ...]
    """Number in each channel."""
    polarized: bool
    """Whether any true frame has DoLP above 0."""
    run_s: float
    """Seconds of the simulation, without writing the files."""
    files: list[str]


def write_simulation(
    pieces: Iterable[Piece],
    camera: Camera,
    name: str,
    folder: Path,
    outputs: Outputs,
    attributes: dict[str, Any],
    total: int | None,
) -> Written:
    """Run a simulation and write its files into `folder`, in constant memory except for the store's columns.

    Events wait in a folder `spool` on disk until the simulation ends. A readout other than the perfect one also needs
    all events of a sensor in memory. `total` is the number of true frames, for the progress bar. ValueError for a
    simulation of more than 71 minutes or without duration.
    """
    started = time.perf_counter()
    truth = GrowingColumns(folder / TRUTH, FRAMES_PER_CHUNK, False, TRUTH_CONVENTIONS)
    duration_us, frames, polarized = 0, 0, False
    with EventSpool(folder / SPOOL) as spool:
        with ProgressBar(total=total, desc="simulate", unit="frame") as bar:
            for piece in pieces:
                duration_us = piece.stop_us
                if duration_us > MAX_DURATION_US:
                    raise ValueError(f"expected at most {MAX_DURATION_US / 6e7:.0f} minutes, got more; cut the clip")
                spool.append(piece.events)
                for t_us, frame in zip(piece.t_us.tolist(), piece.stokes, strict=True):
                    values = _true_frame(t_us, frame)
                    polarized |= bool(values["dolp"].any())
                    truth.add(values)
                frames += len(piece.t_us)
                bar.update(len(piece.t_us))
        truth.flush()
        if duration_us == 0:
            raise ValueError("expected at least two frames, got one: nothing changes, so no pixel fires")
        channels = leave_sensors(spool.channels(), camera, duration_us)
        run_s = time.perf_counter() - started
        files = _write_events(folder, name, channels, camera, duration_us, outputs, attributes)
        if outputs.video_rate_hz is not None:
            files += _write_preview(folder, channels, outputs.video_rate_hz, outputs.gamma)
        size, counts = (channels[0].height, channels[0].width), tuple(map(len, channels))
    shutil.rmtree(folder / SPOOL)
    return Written(duration_us, frames, *size, counts, polarized, run_s, [*files, TRUTH])


def _true_frame(t_us: int, frame: Float32[Tensor, "3 h w"]) -> dict[str, np.ndarray]:
    return {
        "t_us": np.array(t_us, np.int64),
        "s0": quantise_fraction(frame[0].clamp(0, 1)),
        "dolp": quantise_fraction(stokes.dolp(frame).clamp(0, 1)),
        "aolp": quantise_angle(stokes.aolp(frame)),
    }


def _write_events(
    folder: Path,
    name: str,
    channels: Sequence[Events],
    camera: Camera,
    duration_us: int,
    outputs: Outputs,
    attributes: dict[str, Any],
) -> list[str]:
    """Files of the events: one for each sensor of the camera in formats of cameras, and all channels in the store."""
    polarizers = camera.polarizers
    others = [form for form in FORMS if form in outputs.formats]
    files = []
    with ProgressBar(total=len(outputs.formats), desc="write", unit="format") as bar:
        if STORE in outputs.formats:
            size = channels[0].height, channels[0].width
            store = EventStore.create(folder / EVENTS, [name], *size, attributes)
            store.write(name, channels, duration_us)
            store.finish()
            files.append(EVENTS)
            bar.update()
        if polarizers.layout == "dofp" and others:
            sensors = {"sensor": join_mosaic(channels, stokes.parse_mosaic(polarizers.mosaic))}
        else:
            angles = stokes.POLARIZER_ANGLES_DEG
            sensors = {f"polarizer_{a:03d}": events for a, events in zip(angles, channels, strict=True)}
        for form in others:
            suffix, write = FORMS[form]
            for sensor, events in sensors.items():
                write(folder / f"{sensor}{suffix}", events, duration_us)
                files.append(f"{sensor}{suffix}")
            bar.update()
    return files


def _write_preview(folder: Path, channels: Sequence[Events], rate_hz: float, gamma: float) -> list[str]:
    """Write a video with one picture for the events between two true frames, and its busiest picture."""
    busiest = write_true_video(folder / VIDEO, channels, open_truth(folder / TRUTH, ""), rate_hz, gamma)
    if busiest is None:
        return []
    (folder / PICTURE).write_bytes(encode_png(busiest))
    return [VIDEO, PICTURE]
