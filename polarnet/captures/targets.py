"""Put division-of-time captures on one clock, in the stores that every later stage reads.

The stores `events.zarr` and `frames.zarr` have the layout of simulated sequences; all targets are in the split `test`.
"""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from polarnet import stokes
from polarnet.captures.alignment import Alignment, refined_starts
from polarnet.captures.dot import (
    EVENT_CAPTURES,
    INTENSITY_CAPTURES,
    RecordingsConfig,
    Target,
    find_captures,
    landmark_starts,
    read_target,
    region_negative_times_us,
)
from polarnet.events.stream import Events, crop, downscale, shifted, slice_time
from polarnet.recordings.source import RecordingError
from polarnet.storage.events import EventStore
from polarnet.storage.frames import Contents, FrameStore
from polarnet.terminal.progress import ProgressBar

STATUS_FILE = "status.json"
WHITE = 255.0  # maximum of reduced pictures


def start_over(out: Path, *, enabled: bool) -> None:
    """Empty a stage's output folder and write status.json, which says whether real recordings are in use."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    (out / STATUS_FILE).write_text(json.dumps({"enabled": enabled}) + "\n")


class Calibrated(NamedTuple):
    """Calibration result of one target, for a report and a picture."""

    name: str
    landmark_us: Mapping[str, int]
    """Start times by the landmark, by each capture's own clock."""
    start_us: Mapping[str, int]
    """Start times used."""
    alignment: Alignment | None
    """None where the landmark's start times were used unchanged."""
    hot: Mapping[str, int]
    """Number of pixels left out of each event capture."""
    region_events_us: Mapping[str, Int64[np.ndarray, " n"]]
    """Times of the negative events in the landmark's region."""
    region_pictures: Mapping[str, tuple[Int64[np.ndarray, " n"], np.ndarray]]
    """Times of the pictures, and their mean in the region."""
    duration_us: int


def calibrate_targets(
    folders: Sequence[Path], out: Path, config: RecordingsConfig, about: Mapping[str, Any]
) -> list[Calibrated]:
    """Put the targets in `folders` on one clock; write events.zarr, frames.zarr and calibration.json into `out`.

    `about` becomes the stores' attributes. RecordingError where a file is missing or damaged, or a start is not found.
    """
    names = [folder.name for folder in folders]
    for folder in folders:
        find_captures(folder)  # a missing file is reported before hours of decoding
    start_over(out, enabled=True)
    height, width = config.size
    events = EventStore.create(out / "events.zarr", names, height, width, about)
    contents = Contents(dict.fromkeys(names, "test"), about)
    frames = FrameStore.create(out / "frames.zarr", contents, height, width)
    targets = []
    for folder in ProgressBar(folders, "calibrate", unit="target"):
        target = read_target(folder, config)
        one = calibrate_target(target, config)
        channels, t_us, intensity = aligned(target, one, config)
        vectors = stokes.stokes_from_intensities(intensity)
        events.write(target.name, channels, int(t_us[-1]))
        frames.write(target.name, t_us, intensity, stokes.dolp(vectors).clamp(0, 1), stokes.aolp(vectors))
        targets.append(one)
    events.finish()
    frames.finish()
    records = {one.name: _record(one) for one in targets}
    (out / "calibration.json").write_text(json.dumps(records, indent=2) + "\n")
    return targets


def calibrate_target(target: Target, config: RecordingsConfig) -> Calibrated:
    """Start times of a target's captures; RecordingError where one is not found, or what they have in common short."""
    try:
        starts = landmark_starts(target, config)
        alignment = refined_starts(target, starts, config) if config.alignment == "refined" else None
    except RecordingError as error:
        raise RecordingError(f"target {target.name}: {error}") from None
    used = starts if alignment is None else alignment.start_us
    ends = [int(events.t[-1]) - used[capture] if len(events) else 0 for capture, events in target.events.items()]
    ends += [int(pictures.t_us[-1]) - used[capture] for capture, pictures in target.intensities.items()]
    duration_us = min(ends)
    if len(frame_times_us(max(duration_us, 0), config)) < 2:
        raise RecordingError(
            f"target {target.name}: after their starts the captures have {duration_us * 1e-6:.3f} s in common; "
            f"expected at least {1 / config.frame_rate_hz:.3f} s. Is a start wrong? Used: {dict(used)} us"
        )
    late = [c for c in INTENSITY_CAPTURES if target.intensities[c].t_us[0] > used[c]]
    if late:
        raise RecordingError(f"target {target.name}: {', '.join(late)} has no picture before its start; record earlier")
    return Calibrated(
        target.name,
        starts,
        used,
        alignment,
        target.hot,
        {capture: region_negative_times_us(events, config).numpy() for capture, events in target.events.items()},
        {capture: (pictures.t_us, pictures.region) for capture, pictures in target.intensities.items()},
        duration_us,
    )


def aligned(
    target: Target, calibrated: Calibrated, config: RecordingsConfig
) -> tuple[list[Events], Int64[Tensor, " n"], Float32[Tensor, "n 4 h w"]]:
    """The sequence of a target: events of its four channels, frame times, intensities in [0, 1].

    The events are those of the crop from the common start on, reduced by `downscale`.
    The intensities come from the reduced pictures before and after each frame's time, interpolated.
    """
    t_us = frame_times_us(calibrated.duration_us, config)
    channels = []
    for capture in EVENT_CAPTURES:
        events, start = target.events[capture], calibrated.start_us[capture]
        during = shifted(slice_time(events, start, start + int(t_us[-1]) + 1), start)
        part = crop(during, *config.crop_corner, *config.crop)
        channels.append(downscale(part, config.size[0], config.size[1]))
    planes = []
    for name in INTENSITY_CAPTURES:
        frames = target.intensities[name].since(calibrated.start_us[name], config)(t_us)
        planes.append(torch.from_numpy(frames).float().div_(WHITE).clamp_(0, 1))
    return channels, torch.from_numpy(t_us), torch.stack(planes, dim=1)


def frame_times_us(duration_us: int, config: RecordingsConfig) -> Int64[np.ndarray, " n"]:
    """Times of the ground-truth frames, starting at 0."""
    count = int(duration_us * 1e-6 * config.frame_rate_hz) + 1
    return np.rint(np.arange(count) * 1e6 / config.frame_rate_hz).astype(np.int64)


def _record(calibrated: Calibrated) -> dict[str, Any]:
    record: dict[str, Any] = {name: getattr(calibrated, name) for name in ("landmark_us", "start_us", "duration_us")}
    record["hot_pixels"] = calibrated.hot
    if calibrated.alignment is not None:
        record["redundancy_residual"] = calibrated.alignment.residual
        for capture, lag in zip(EVENT_CAPTURES, calibrated.alignment.lags, strict=True):
            known = {key: None if np.isnan(value) else value for key, value in lag.thresholds._asdict().items()}
            record[capture] = {"agreement": lag.agreement, "thresholds": known}
    return record
