"""Recordings with true polarization as a test set: stores of events and frames, and a check of their common clock."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from polarnet.captures.alignment import MAX_PICTURES, Lag, best_lag, logarithms, steps
from polarnet.events.stream import Events, shifted, slice_time, split_mosaic
from polarnet.events.streaming import TRAINED_WINDOW_US
from polarnet.recordings.arrangements import Piece
from polarnet.recordings.formats.celex5 import WHITE
from polarnet.recordings.noise import Cleaner, Cleaning
from polarnet.recordings.recording import detect_format, read_recording
from polarnet.recordings.source import RecordingError
from polarnet.recordings.truth import Truth, check_size, read_truth, truth_formats
from polarnet.stokes import Mosaic
from polarnet.storage.events import EventStore
from polarnet.storage.frames import Contents, FrameStore
from polarnet.terminal.progress import ProgressBar

MAX_WINDOW_RATIO = 1.25  # between the frames' interval and the networks' window, beyond which a warning says so
MIN_AGREEMENT = 0.1  # correlation of events and frames (`Lag.agreement`); below it their lag is not known
MAX_LAG = 0.5  # frame intervals
MAX_LISTED = 8  # files that a note names


class Recorded(NamedTuple):
    """One recording on the clock of its first frame."""

    name: str
    channels: Sequence[Events]
    truth: Truth
    notes: list[str]  # warnings about its clock and its noise, a sentence each


def make_recorded_set(root: Path, folder: Path, mosaic: Mosaic, cleaning: Cleaning) -> list[str]:
    """Write every recording with frames under `root` into `folder` as events.zarr and frames.zarr; returns notes.

    All sequences are in the split test, one scene each. ValueError if there is no recording with frames, or if they
    have several sizes.
    """
    if not root.is_dir():
        raise ValueError(f"{root}: expected a folder of recordings, got {'a file' if root.exists() else 'none'}")
    recordings, notes, others = [], [], []
    files = sorted(path for path in root.rglob("*") if path.is_file())
    for path in ProgressBar(files, "recordings", unit="file"):
        try:
            if _holds_frames(path):
                recordings.append(read_recorded(path, path.relative_to(root).as_posix(), mosaic, cleaning))
            else:
                others.append(path.name)
        except RecordingError as error:
            notes.append(f"{path.name} was skipped: {str(error).removeprefix(f'{path.name}: ')}.")
    if others:
        more = f" and {len(others) - MAX_LISTED} more" if len(others) > MAX_LISTED else ""
        names = f"{', '.join(others[:MAX_LISTED])}{more}"
        notes.append(f"Skipped, because only files of {', '.join(truth_formats())} hold frames: {names}.")
    if not recordings:
        raise ValueError(f"{root}: no recording with true polarization. {' '.join(notes) or 'The folder is empty.'}")
    sizes = {one.truth.dolp.shape[1:] for one in recordings}
    if len(sizes) > 1:
        raise ValueError(f"{root}: expected recordings of one size, got {sorted(map(tuple, sizes))}; use a folder each")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    _write(folder, recordings)
    return [*notes, *(note for one in recordings for note in one.notes)]


def _holds_frames(path: Path) -> bool:
    """Whether a file has a format with frames."""
    try:
        return detect_format(path) in truth_formats()
    except RecordingError:
        return False


def read_recorded(path: Path, name: str, mosaic: Mosaic, cleaning: Cleaning) -> Recorded:
    """The four channels of a recording, without noise, and its frames; both last from the first frame to the last.

    Frames more than one interval before the first event or after the last are left out. RecordingError if fewer than
    three remain, as with different clocks, or if frames and sensor differ in size.
    """
    events, truth = read_recording(path).events, read_truth(path, mosaic)
    check_size(path, truth, events.height, events.width)
    first_us, last_us = (int(events.t[0]), int(events.t[-1])) if len(events) else (0, 0)
    interval_us = int(np.median(np.diff(truth.t_us))) if len(truth.t_us) > 1 else 0
    during = (truth.t_us >= first_us - interval_us) & (truth.t_us <= last_us + interval_us)
    if during.sum() < 3:
        raise RecordingError(
            f"{path.name}: expected events and frames on one clock, got events from {first_us} to {last_us} us and "
            f"frames from {truth.t_us[0]} to {truth.t_us[-1]} us; bring them onto one clock"
        )
    keep = torch.from_numpy(during)
    truth = Truth._make(values[keep] if torch.is_tensor(values) else values[during] for values in truth)
    notes = [f"{name}: {note}" for note in clock_notes(truth.t_us, frame_lag(events, truth))]
    start_us, stop_us = int(truth.t_us[0]), int(truth.t_us[-1])
    cleaner = Cleaner(cleaning, mosaic)
    (piece,) = cleaner.clean([Piece(split_mosaic(events, mosaic), last_us - first_us, 0.0)])
    if any(cleaner.removed.values()):
        notes.append(f"{name}: removed {cleaner.sentence()}, of {len(events):,}.")
    channels = [shifted(slice_time(one, start_us, stop_us), start_us) for one in piece.channels]
    return Recorded(name, channels, truth._replace(t_us=truth.t_us - start_us), notes)


def frame_lag(events: Events, truth: Truth) -> Lag:
    """Delay of the frames' clock relative to the events', from pixels whose light changes, within 2 frame intervals."""
    frames = slice(0, MAX_PICTURES)
    t_us, height, width = truth.t_us[frames], *truth.light.shape[1:]
    levels = np.rint(truth.light[frames] * WHITE).astype(np.uint16)
    pairs = steps(events, (0, 0), (height, width), int(t_us[0]), int(t_us[-1]))
    return best_lag(pairs, t_us.astype(np.int64), logarithms(levels), 2 * float(np.median(np.diff(t_us))))


def clock_notes(t_us: np.ndarray, lag: Lag) -> list[str]:
    """Warnings about the times of the frames, a sentence each."""
    interval_us = float(np.median(np.diff(t_us)))
    notes = []
    if lag.agreement < MIN_AGREEMENT:
        notes.append(
            f"events and frames hardly agree ({lag.agreement:.2f} at best): whether they are on one clock is unknown."
        )
    elif abs(lag.lag_us) > MAX_LAG * interval_us:
        notes.append(
            f"the frames seem to be {lag.lag_us / 1000:+.1f} ms late against the events, with one frame every "
            f"{interval_us / 1000:.1f} ms; correct their times."
        )
    ratio = interval_us / TRAINED_WINDOW_US
    if not 1 / MAX_WINDOW_RATIO <= ratio <= MAX_WINDOW_RATIO:
        notes.append(
            f"the windows between frames are {interval_us / 1000:.1f} ms long; networks were trained on "
            f"{TRAINED_WINDOW_US / 1000:.1f} ms."
        )
    return notes


def _write(folder: Path, recordings: Sequence[Recorded]) -> None:
    names = [one.name for one in recordings]
    height, width = recordings[0].truth.dolp.shape[1:]
    events = EventStore.create(folder / "events.zarr", names, height, width, {})
    contents = Contents(dict.fromkeys(names, "test"), masked=True)
    frames = FrameStore.create(folder / "frames.zarr", contents, height, width)
    for name, channels, truth, _ in recordings:
        events.write(name, channels, int(truth.t_us[-1]))
        frames.write(name, truth.t_us, truth.intensity.clamp(0, 1), truth.dolp, truth.aolp, truth.valid)
    events.finish()
    frames.finish()
