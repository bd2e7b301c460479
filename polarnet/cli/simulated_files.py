"""Files of `polarnet simulate`: events in several formats, true frames, and a preview, from a simulation in pieces."""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from polarnet import stokes
from polarnet.clips.video import Piece
from polarnet.events.stream import Events, join_mosaic
from polarnet.recordings.writers import FORMS
from polarnet.reports.maps import encode_png
from polarnet.reports.preview import write_true_video
from polarnet.simulation.camera import Camera, pixel_analyzers
from polarnet.simulation.moving_sensor import leave_sensors
from polarnet.storage.events import MAX_DURATION_US, EventStore
from polarnet.storage.frames import CONVENTIONS, FRAMES_PER_CHUNK, quantise
from polarnet.storage.groups import GrowingColumns
from polarnet.storage.true_frames import APPENDED, open_truth
from polarnet.terminal.progress import ProgressBar

STORE = "store"
FORMATS = (STORE, *FORMS)
EVENTS, TRUTH, VIDEO, PICTURE, SPOOL = "events.zarr", APPENDED, "preview.mp4", "preview.png", "spool"
ANALYZER = "analyzer.npy"
TRUTH_CONVENTIONS = {**CONVENTIONS, "s0": "S0 = I0 + I90: value / 65535"}
COLUMNS: dict[str, type[np.generic]] = {"t": np.int64, "x": np.int16, "y": np.int16, "p": np.int8}


class Output(NamedTuple):
    """Place and formats of the files of a simulation."""

    folder: Path
    name: str  # of the sequence
    formats: Sequence[str]  # some of FORMATS
    gamma: float | None  # of S0 in the preview; None: no preview
    attributes: dict[str, Any]  # of the event store


def _spool(folder: Path, channels: Sequence[Events]) -> None:
    """Append a piece of every channel to a file for each column of each channel."""
    for k, events in enumerate(channels):
        for name in COLUMNS:
            with (folder / f"{k}.{name}").open("ab") as file:
                file.write(getattr(events, name).numpy().tobytes())


def _spooled(folder: Path, channel: int, height: int, width: int) -> Events:
    """All events of a channel in these files; its columns stay on disk until they are used."""
    columns = []
    for name, dtype in COLUMNS.items():
        file = folder / f"{channel}.{name}"
        columns.append(np.memmap(file, dtype, mode="c") if file.stat().st_size else np.empty(0, dtype))  # no empty map
    t, x, y, p = map(torch.from_numpy, columns)
    return Events(t, x, y, p, height, width)


def write_simulation(
    pieces: Iterable[Piece], camera: Camera, total: int | None, output: Output
) -> tuple[dict[str, str], list[str]]:
    """Run a simulation and write its files, in constant memory except for the store's columns; returns facts and notes.

    Events wait on disk until the simulation ends. A readout with a limit also needs all events of a sensor in memory.
    `total` is the expected number of true frames; None: unknown. ValueError for a simulation of more than 71 minutes or
    without duration.
    """
    spool, size = output.folder / SPOOL, (0, 0)
    spool.mkdir()
    truth = GrowingColumns(output.folder / TRUTH, FRAMES_PER_CHUNK, False, TRUTH_CONVENTIONS)
    duration_us, frames, polarized = 0, 0, False
    with ProgressBar(total=total, desc="simulate", unit="frame") as bar:
        for piece in pieces:
            duration_us = piece.stop_us
            if duration_us > MAX_DURATION_US:
                raise ValueError(f"expected at most {MAX_DURATION_US / 6e7:.0f} minutes, got more; cut the clip")
            size = piece.events[0].height, piece.events[0].width
            _spool(spool, piece.events)
            for t_us, frame in zip(piece.t_us.tolist(), piece.stokes, strict=True):
                dolp = quantise("dolp", stokes.dolp(frame).clamp(0, 1))
                s0, aolp = quantise("s0", frame[0].clamp(0, 1)), quantise("aolp", stokes.aolp(frame))
                polarized |= bool(dolp.any())
                truth.add({"t_us": np.array(t_us, np.int64), "s0": s0, "dolp": dolp, "aolp": aolp})
            frames += len(piece.t_us)
            bar.update(len(piece.t_us))
    truth.flush()
    if duration_us == 0:
        raise ValueError("expected at least two frames, got one: nothing changes, so no pixel fires")
    channels = leave_sensors([_spooled(spool, k, *size) for k in range(stokes.NUM_CHANNELS)], camera, duration_us)
    files = _write_events(channels, camera, duration_us, output)
    if output.gamma is not None:
        frames_on_disk = open_truth(output.folder / TRUTH, "")
        busiest = write_true_video(output.folder / VIDEO, channels, frames_on_disk, gamma=output.gamma)
        if busiest is not None:
            (output.folder / PICTURE).write_bytes(encode_png(busiest))
            files += [VIDEO, PICTURE]
    files.append(TRUTH)
    shutil.rmtree(spool)
    counts = dict(zip(stokes.POLARIZER_ANGLES_DEG, map(len, channels), strict=True))
    events, seconds = sum(counts.values()), duration_us * 1e-6
    facts = {
        "channels": f"4 of {channels[0].height} x {channels[0].width} px, {camera.polarizers.layout}",
        "duration": f"{seconds:.3f} s, {frames:,} true frames",
        "events": f"{events:,} ({events / seconds:,.0f}/s): "
        + ", ".join(f"{count:,} at {angle}" for angle, count in counts.items())
        + " degrees",
        "files": ", ".join(files),
    }
    notes = [] if polarized else ["the frames are grey, so DoLP is 0 everywhere"]
    if total is not None and frames < total:
        notes.append(f"the file states {total:,} frames, {frames:,} could be read")
    return facts, notes


def _write_events(channels: Sequence[Events], camera: Camera, duration_us: int, output: Output) -> list[str]:
    """Files of the events: one for each sensor of the camera in formats of cameras, and all channels in the store."""
    polarizers, files = camera.polarizers, [ANALYZER]
    pitch = 2 if polarizers.layout == "dofp" else 1
    analyzer = pixel_analyzers(camera, pitch * channels[0].height, pitch * channels[0].width)
    np.save(output.folder / ANALYZER, analyzer.numpy())
    sensors = {f"polarizer_{a:03d}": one for a, one in zip(stokes.POLARIZER_ANGLES_DEG, channels, strict=True)}
    if polarizers.layout == "dofp" and set(output.formats) - {STORE}:
        sensors = {"sensor": join_mosaic(channels, stokes.parse_mosaic(polarizers.mosaic))}
    for form in ProgressBar([form for form in FORMATS if form in output.formats], "write", unit="format"):
        if form == STORE:
            size = channels[0].height, channels[0].width
            store = EventStore.create(output.folder / EVENTS, [output.name], *size, output.attributes)
            store.write(output.name, channels, duration_us, analyzer=analyzer)
            store.finish()
            files.append(EVENTS)
            continue
        suffix, write = FORMS[form]
        for sensor, events in sensors.items():
            write(output.folder / f"{sensor}{suffix}", events)
            files.append(f"{sensor}{suffix}")
    return files
