"""Inputs of `polarnet recover`: files in any arrangement of polarizers, stores, live input."""

import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from polarnet.events.rotation import Rotation, steady_rotation, triggered_rotation
from polarnet.events.stream import Events
from polarnet.recordings.arrangements import FilePieces, Input, Open, open_four, open_mosaic, open_plain
from polarnet.recordings.formats import hdf5
from polarnet.recordings.live import SCHEME, read_camera, read_lines
from polarnet.recordings.recording import first_time_us, open_recording
from polarnet.recordings.source import RecordingError
from polarnet.recordings.truth import check_size, read_truth
from polarnet.stokes import Mosaic, StokesFrames, stokes_from_polarization
from polarnet.storage.events import EventStore
from polarnet.storage.parts import METADATA, unknown_sequence

STANDARD_INPUT = "-"
STEPS_PER_BLOCK = 64  # steps of the store's index, 2**14 events each


def open_channels(
    paths: Sequence[Path],
    angles: Sequence[int] | None = None,
    mosaic: Mosaic | None = None,
    sequence: str | None = None,
    open_file: Open = open_recording,
) -> Input:
    """The four channels in files, starting at time 0; a ValueError says what is missing.

    Four files hold one channel each, behind polarizers at `angles`, in degrees and in the order of the files. A single
    path is a recording of a camera with a `mosaic`, or an event store, of which `sequence` is read.
    """
    if len(paths) == 4:
        if angles is None:
            raise ValueError("four files: say the polarizer of each, in their order, such as --angles 0 45 90 135")
        return open_four(dict(zip(angles, paths, strict=True)), open_file)
    if len(paths) != 1 or angles is not None:
        raise ValueError(f"expected one file or folder, or four files with --angles, got {len(paths)}")
    (path,) = paths
    if mosaic is not None:
        return open_mosaic(path, mosaic, open_file)
    if not (path / METADATA).is_file():
        raise ValueError(
            f"{path.name} is one file of events: say where the polarizers of its pixels are, such as --mosaic "
            f"'90 45 / 135 0', or give four files with --angles, or an event store"
        )
    store = EventStore.open(path)
    name = store.sequences[0] if sequence is None and len(store.sequences) == 1 else sequence
    if name not in store.sequences:
        raise ValueError(f"{path.name}: --sequence: {unknown_sequence(name, store.sequences)}")
    return _stored(path.name, store, name)


def _stored(name: str, store: EventStore, sequence: str) -> Input:
    """A sequence of a store, in blocks of about a million events."""

    def blocks() -> Iterator[Sequence[Events]]:
        times = sorted(itertools.chain(*store.record(sequence)["index"]))
        edges = [0, *sorted(set(times[STEPS_PER_BLOCK::STEPS_PER_BLOCK]) - {0}), None]
        for start_us, stop_us in itertools.pairwise(edges):
            yield store.read(sequence, start_us, stop_us)

    return Input(name, store.height, store.width, FilePieces(blocks, origin_us=0))


def open_rotating(path: Path, rotation: Rotation, open_file: Open) -> tuple[Input, Rotation]:
    """Open the events of one camera behind a rotating polarizer, whose times count from the first event.

    `rotation` is by the file's clock, the returned one by that of the events. RecordingError for a file without events.
    """
    return open_plain(path, open_file), rotation.since(first_time_us(open_file(path)))


def open_frames(path: Path, mosaic: Mosaic, open_file: Open) -> StokesFrames:
    """The frames of a recording, whose times count from its first event as those of `open_channels` do.

    RecordingError for a file without events, of another format than those with frames, or without frames.
    """
    truth, reader = read_truth(path, mosaic), open_file(path)
    check_size(path, truth, reader.height, reader.width)
    stokes = stokes_from_polarization(torch.ones_like(truth.dolp), truth.dolp, truth.aolp)[:, 1:]
    return StokesFrames(truth.t_us, stokes, truth.valid).since(first_time_us(reader))


def open_live(path: str, mosaic: Mosaic | None, idle_s: float) -> Input:
    """Read live from standard input (-), a file, or a camera (dv://...), which ends after `idle_s` without an event.

    ValueError for a camera without a mosaic.
    """
    if path.startswith(SCHEME):
        if mosaic is None:
            raise ValueError(f"{path}: expected --mosaic, the polarizers of the camera's pixels, with a camera")
        return read_camera(path, mosaic, idle_s)
    if path == STANDARD_INPUT:
        return read_lines(sys.stdin.buffer, "standard input", mosaic)
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: there is no such file; - reads standard input")
    return read_lines(open(path, "rb"), Path(path).name, mosaic)


def rotation_of(rate_hz: float | None, triggers: Path | None, start_angle_deg: float) -> Rotation:
    """The rotation at `rate_hz` from time 0 of the file, or through one trigger a turn.

    `triggers` is a text file with a time in microseconds on each line, or an HDF5 file with a table /triggers.
    With both, the rate gives the sense of rotation. ValueError if there are fewer than two triggers.
    """
    start_angle = math.radians(start_angle_deg)
    if triggers is not None:
        turn = 1.0 if rate_hz is None else math.copysign(1.0, rate_hz)
        return triggered_rotation(_trigger_times_us(triggers), start_angle, turn)
    if rate_hz is None:
        raise ValueError("expected the rate of the polarizer (--rate HZ) or its triggers (--triggers FILE)")
    return steady_rotation(rate_hz, start_angle)


def _trigger_times_us(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        if file.read(len(hdf5.MAGIC)) == hdf5.MAGIC:
            return hdf5.trigger_times_us(path)
    try:
        return np.array([int(line) for line in path.read_text().split()], np.int64)
    except ValueError:
        raise RecordingError(f"{path.name}: expected a time in whole microseconds on each line") from None
