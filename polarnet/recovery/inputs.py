"""Inputs of `polarnet recover`: files in any arrangement of polarizers, stores, folders of captures, live input."""

import math
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polarnet.captures.dot import EVENT_CAPTURES, RecordingsConfig
from polarnet.captures.targets import calibrate_targets, import_targets
from polarnet.events.rotation import Rotation, steady_rotation, triggered_rotation
from polarnet.events.stream import Events, downscale
from polarnet.events.streaming import WindowRule
from polarnet.recordings.arrangements import read_four, read_mosaic, read_plain, shifted
from polarnet.recordings.formats import hdf5
from polarnet.recordings.live import SCHEME, LiveCamera, LiveLines, Piece
from polarnet.recordings.noise import Cleaner
from polarnet.recordings.recording import Recording, detect_format, read_recording
from polarnet.recordings.source import RecordingError
from polarnet.recovery.stream import Input
from polarnet.stokes import POLARIZER_ANGLES_DEG, Mosaic
from polarnet.storage.events import EventStore
from polarnet.storage.exchange import EXPORT_INDEX
from polarnet.storage.parts import unknown_sequence

STANDARD_INPUT = "-"


@dataclass(frozen=True)
class Files:
    """Files to recover, and the arrangement of their polarizers, as the user gives them."""

    paths: Sequence[Path]
    angles: Sequence[int] | None = None
    """Polarizer angle of each of four files, in degrees and in the order of the files."""
    mosaic: Mosaic | None = None
    sequence: str | None = None
    """Sequence to read from an event store or a folder that holds several."""
    plain: bool = False
    """Whether any other file is one channel, of a camera without polarizers."""
    read: Callable[[Path], Recording] = read_recording
    captures: RecordingsConfig | None = None
    """Settings of division-of-time captures; needed for a folder of them."""


def open_files(files: Files, work: Path, size: Sequence[int] | None = None, clean: Cleaner | None = None) -> Input:
    """Read channels from files, starting at time 0 and reduced to `size` (height, width) if given.

    Four files hold one channel each. A single path is a recording of a camera with a mosaic, an event store, a folder
    that `polarnet export` wrote, or a folder of division-of-time captures, which are calibrated in `work`. `clean`
    removes noise before the size is reduced. A ValueError or FileNotFoundError says what is missing.
    """
    missing = [str(path) for path in files.paths if not path.exists()]
    if missing:
        raise FileNotFoundError(f"{', '.join(missing)}: there is no such file")
    return _whole(", ".join(path.name for path in files.paths), _channels(files, work), size, clean)


def open_rotating(
    path: Path, rotation: Rotation, read: Callable[[Path], Recording], size: Sequence[int] | None
) -> tuple[Input, Rotation]:
    """Read the events of one camera behind a rotating polarizer, and count times from the first event.

    `rotation` is by the file's clock, the returned one by that of the events. RecordingError for a file without events.
    """
    events = read(path).events
    if not len(events):
        raise RecordingError(f"{path.name}: expected events, the file has none")
    start_us = int(events.t[0])
    return _whole(path.name, [shifted(events, start_us)], size), rotation.since(start_us)


def open_live(path: str, mosaic: Mosaic | None, idle_s: float) -> Input:
    """Read live from standard input (-), a growing file or a camera (dv://...), until `idle_s` seconds without data.

    ValueError for a camera without a mosaic.
    """
    reader: LiveLines | LiveCamera
    if path.startswith(SCHEME):
        if mosaic is None:
            raise ValueError(f"{path}: expected --mosaic, the polarizers of the camera's pixels, with a camera")
        reader = LiveCamera(path, mosaic, idle_s)
    elif path == STANDARD_INPUT:
        reader = LiveLines(sys.stdin.buffer, "standard input", mosaic, idle_s)
    elif Path(path).is_file():
        reader = LiveLines(open(path, "rb"), Path(path).name, mosaic, idle_s)  # noqa: SIM115 - read until the end
    else:
        raise FileNotFoundError(f"{path}: there is no such file; - reads standard input")
    return Input(reader.name, reader.height, reader.width, reader, None, left_out=reader.counts)


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
        raise ValueError("expected the rate of the polarizer (--rotating HZ) or its triggers (--triggers FILE)")
    return steady_rotation(rate_hz, start_angle)


def half_turn_rule(rotation: Rotation, step_us: int | None = None) -> WindowRule:
    """Consecutive windows of `step_us` (default: half a turn)."""
    return WindowRule(step_us or max(1, round(rotation.half_turn_us)), None, None)


def _whole(name: str, channels: Sequence[Events], size: Sequence[int] | None, clean: Cleaner | None = None) -> Input:
    duration_us = max((int(events.t[-1]) + 1 for events in channels if len(events)), default=0)
    if clean is not None:
        channels = clean(channels, duration_us)
    if size is not None:
        channels = [downscale(events, *size, keep_rate=True) for events in channels]
    pieces = [Piece(channels, duration_us, time.perf_counter())]
    return Input(name, channels[0].height, channels[0].width, pieces, duration_us, len(channels))


def _channels(files: Files, work: Path) -> Sequence[Events]:
    if len(files.paths) == 4:
        if files.angles is None:
            raise ValueError("four files: say the polarizer of each, in their order, such as --angles 0 45 90 135")
        return read_four(dict(zip(files.angles, files.paths, strict=True)), read=files.read)
    if len(files.paths) != 1 or files.angles is not None:
        raise ValueError(f"expected one file or folder, or four files with --angles, got {len(files.paths)}")
    (path,) = files.paths
    if files.mosaic is not None:
        return read_mosaic(path, files.mosaic, files.read)
    if path.is_dir() and any(path.glob(f"{EVENT_CAPTURES[0]}.*")):
        return _captured(path, work, files.captures)
    if path.is_dir() and (exported := _exported(path, files.sequence)):
        return read_four(exported, dict.fromkeys(exported, 0), files.read)  # times count from the sequence's start
    if detect_format(path) == "store":
        store = EventStore.open(path)
        return store.read(_named(files.sequence, store.sequences, path.name))
    if files.plain:
        return read_plain(path, files.read)
    raise ValueError(
        f"{path.name} is one file of events: say where the polarizers of its pixels are, such as --mosaic "
        f"'90 45 / 135 0', or give four files with --angles, an event store, or a folder of {EVENT_CAPTURES[0]}.*, "
        f"...; for its intensity alone, give a --method that reconstructs it, such as firenet or highpass"
    )


def _exported(folder: Path, sequence: str | None) -> dict[int, Path]:
    """Files by angle in a folder that `polarnet export` or `polarnet simulate` wrote; empty for any other folder."""
    if (folder / EXPORT_INDEX).is_file():
        names = sorted(path.name for path in folder.iterdir() if path.is_dir())
        folder = folder / _named(sequence, names, folder.name)
    files = {angle: sorted(folder.glob(f"polarizer_{angle:03d}.*")) for angle in POLARIZER_ANGLES_DEG}
    if not all(files.values()):
        return {}
    if several := next((paths for paths in files.values() if len(paths) > 1), None):
        raise ValueError(
            f"{folder}: expected one file for each polarizer, got {', '.join(path.name for path in several)}; "
            f"name the four files, with --angles 0 45 90 135"
        )
    return {angle: path for angle, (path,) in files.items()}


def _named(sequence: str | None, names: list[str], where: str) -> str:
    """The sequence of that name, or the only one; ValueError if there is none."""
    if sequence is None and len(names) == 1:
        return names[0]
    if sequence is None or sequence not in names:
        raise ValueError(f"{where}: --sequence: {unknown_sequence(sequence, names)}")
    return sequence


def _captured(folder: Path, work: Path, config: RecordingsConfig | None) -> Sequence[Events]:
    if config is None:
        raise ValueError(f"{folder.name}: expected the settings of division-of-time captures, section recordings")
    root = work / "targets"
    shutil.rmtree(root, ignore_errors=True)  # of a run on another folder, maybe of the same name
    root.mkdir(parents=True)
    target = root / folder.resolve().name
    target.symlink_to(folder.resolve(), target_is_directory=True)
    import_targets(root, work / "imported", config)
    calibrate_targets(work / "imported", work / "calibrated", config, {})
    return EventStore.open(work / "calibrated" / "events.zarr").read(target.name)


def _trigger_times_us(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        if file.read(len(hdf5.MAGIC)) == hdf5.MAGIC:
            return hdf5.trigger_times_us(path)
    try:
        return np.array([int(line) for line in path.read_text().split()], np.int64)
    except ValueError:
        raise RecordingError(f"{path.name}: expected a time in whole microseconds on each line") from None
