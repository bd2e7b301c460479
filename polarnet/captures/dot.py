"""Division-of-time captures of one target (paper, section 4): four of events, four of intensity, each with its clock.

A target moves in the same way eight times, behind a polarizer at 0, 45, 90 and 135 degrees. In each capture a dark
landmark enters a region of the picture. That moment is time 0 of the clock that all eight share.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt16
from pydantic import Field, PositiveFloat, PositiveInt, StrictInt, TypeAdapter
from torch import Tensor

from polarnet.events.stream import Events, crop
from polarnet.pictures.clips import TIMES_FILE, VIDEOS, ClipOptions, check_times, open_clip, times_from_file
from polarnet.recordings.formats.celex5 import Picture, celex5_pictures
from polarnet.recordings.noise import event_counts, hot_pixels, without_pixels
from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError
from polarnet.runtime.sections import one_of, section
from polarnet.stokes import POLARIZER_ANGLES_DEG

EVENT_CAPTURES = tuple(f"events_{angle}" for angle in POLARIZER_ANGLES_DEG)
INTENSITY_CAPTURES = tuple(f"intensity_{angle}" for angle in POLARIZER_ANGLES_DEG)
CAPTURES = (*EVENT_CAPTURES, *INTENSITY_CAPTURES)
STARTS_FILE = "starts.json"
STEPS_OF_8_BITS = 16.0  # 12-bit steps per level of 8 bits, the scale of the vendor's programs and of `dark_level`


@section
class RecordingsConfig:
    """Section `recordings` of params.yaml. Sizes are [height, width] in pixels."""

    enabled: bool
    root: str
    """Folder with one folder for each target."""
    sensor: list[Annotated[int, Field(ge=8, le=1280)]]
    """The part of the sensor in use, from its upper left corner."""
    region: list[Annotated[int, Field(ge=1, le=1280)]]
    """Size of the landmark's region, in the upper right corner of the part in use."""
    dark_level: Annotated[float, Field(gt=0, le=255)]
    """An intensity capture starts with the first picture whose mean in the region is below this level, of 255."""
    negative_events: PositiveInt
    """Number of negative events in the region at which an event capture starts."""
    crop: list[Annotated[int, Field(ge=2, le=1280)]]
    """Size of the central crop."""
    size: list[Annotated[int, Field(ge=2, le=1280)]]
    """Size to which the crop is reduced."""
    hot_pixel_factor: Annotated[float, Field(gt=1)] | None
    """A pixel is hot, and left out, above this multiple of the third busiest of the 5 x 5 around it; null: none is."""
    alignment: Annotated[str, one_of(("landmark", "refined"))]
    """landmark: start times by the landmark alone (the paper); refined: refined over the whole picture."""
    refine_within_ms: PositiveFloat
    """Search range of the refined start times around the landmark's."""
    frame_rate_hz: PositiveFloat
    """Frame rate of the sequence's ground truth, which lasts as long as all captures do from the landmark on."""

    def __post_init__(self):
        for inner, outer in (("sensor", "sensor"), ("region", "sensor"), ("crop", "sensor"), ("size", "crop")):
            size, limit = getattr(self, inner), getattr(self, outer)
            if len(size) != 2:
                raise ValueError(f"{inner}: expected [height, width], got {list(size)}")
            if any(a > b for a, b in zip(size, limit, strict=True)):
                raise ValueError(f"{inner}: expected at most the {outer}'s {list(limit)}, got {list(size)}")

    @property
    def crop_corner(self) -> tuple[int, int]:
        """Row and column of the crop's upper left pixel."""
        return (self.sensor[0] - self.crop[0]) // 2, (self.sensor[1] - self.crop[1]) // 2


class IntensityCapture(NamedTuple):
    """The pictures of one intensity capture, cropped, with their times."""

    t_us: Int64[np.ndarray, " n"]
    """Times of the pictures, by the capture's own clock."""
    pictures: UInt16[np.ndarray, "n h w"]
    """Values within the crop, 0 to 4095, linear in light."""
    region: Float64[np.ndarray, " n"]
    """Mean in the landmark's region, 0 to 255."""

    def since(self, start_us: float | int, config: RecordingsConfig, chosen: slice = slice(None)) -> Any:
        """The reduced pictures as a function of the time since `start_us`: linear between two, and beyond them."""
        from scipy.interpolate import make_interp_spline  # half a second, which every stage would pay

        pictures = np.stack([reduced(picture, config) for picture in self.pictures[chosen]])
        return make_interp_spline(self.t_us[chosen] - start_us, pictures, k=1)


class Target(NamedTuple):
    """The eight captures of one target, each by its own clock."""

    name: str
    events: Mapping[str, Events]
    """Events without those of hot pixels."""
    hot: Mapping[str, int]
    """Number of hot pixels in each event capture."""
    intensities: Mapping[str, IntensityCapture]
    given: Mapping[str, int]
    """Start times set by hand."""


def read_target(folder: Path, config: RecordingsConfig) -> Target:
    """The captures in a target's folder; RecordingError where a file is missing or damaged."""
    files, clean, hot = find_captures(folder), {}, {}
    for capture in EVENT_CAPTURES:
        events = read_event_capture(files[capture], config)
        bad = np.zeros((events.height, events.width), np.bool_)
        if config.hot_pixel_factor is not None:
            duration_s = float(events.t[-1] - events.t[0]) * 1e-6 if len(events) else 0.0
            bad = hot_pixels(event_counts(events), duration_s, config.hot_pixel_factor)
        clean[capture], hot[capture] = without_pixels(events, bad), int(bad.sum())
    intensities = {capture: read_intensity_capture(files[capture], config) for capture in INTENSITY_CAPTURES}
    return Target(folder.name, clean, hot, intensities, given_starts(folder))


def find_captures(folder: Path) -> dict[str, Path]:
    """The eight captures of a target: events_0.*, ..., events_135.*, intensity_0.*, ..., intensity_135.*.

    An intensity capture is a BIN file, a video, or a folder of frames; intensity_0.txt holds the times of a file.
    RecordingError where a capture has no file or more than one.
    """
    captures = {}
    for name in CAPTURES:
        times = name in INTENSITY_CAPTURES and folder / f"{name}.txt"
        files = sorted(path for path in folder.glob(f"{name}*") if path.stem == name and path != times)
        if len(files) != 1:
            raise RecordingError(
                f"target {folder.name}: expected one file {name}.bin (or another ending), got "
                f"{', '.join(path.name for path in files) or 'none'}; a target has {', '.join(CAPTURES)}"
            )
        captures[name] = files[0]
    return captures


def given_starts(folder: Path) -> dict[str, int]:
    """Start times set by hand in starts.json, {"events_45": microseconds, ...}; empty without the file."""
    path = folder / STARTS_FILE
    if not path.exists():
        return {}
    try:
        return TypeAdapter(dict[Literal[CAPTURES], StrictInt]).validate_json(path.read_text())  # type: ignore[valid-type]
    except ValueError as error:
        raise RecordingError(
            f"{folder.name}/{path.name}: expected whole microseconds of the capture's own clock for any of "
            f"{', '.join(CAPTURES)}: {error}"
        ) from error


def read_event_capture(path: Path, config: RecordingsConfig) -> Events:
    """Events from the part of the sensor in use, by the capture's own clock."""
    height, width = config.sensor
    events = read_recording(path).events
    if events.height < height or events.width < width:
        raise RecordingError(
            f"{path.name}: recordings.sensor is {height}x{width}, the file's sensor {events.height}x{events.width}"
        )
    return crop(events, 0, 0, height, width)


def read_intensity_capture(path: Path, config: RecordingsConfig) -> IntensityCapture:
    """The pictures of a BIN file, a video or a folder of frames, whose values are linear in light.

    A text of times, intensity_0.txt or timestamps.txt in the folder, comes before the times in a file. RecordingError
    where the pictures are fewer than two, without times, or smaller than the sensor.
    """
    (top, left), (height, width) = config.crop_corner, config.crop
    landmark = np.s_[: config.region[0], config.sensor[1] - config.region[1] : config.sensor[1]]
    text = path / TIMES_FILE if path.is_dir() else path.with_suffix(".txt")
    stated = times_from_file(text, "us").tolist() if text.is_file() else None
    times, pictures, region = [], [], []
    bin_file = path.is_file() and path.suffix.lower().lstrip(".") not in VIDEOS
    for picture in celex5_pictures(path) if bin_file else _frames(path):
        if any(side < used for side, used in zip(picture.intensity.shape, config.sensor, strict=True)):
            size = "x".join(map(str, picture.intensity.shape))
            raise RecordingError(f"{path.name}: recordings.sensor is {config.sensor}, its pictures are {size}")
        if picture.t_us is None and stated is None:
            raise RecordingError(
                f"{path.name}: its pictures have no times (a BIN file recorded without the IMU's data, or frames of a "
                f"folder); write microseconds into {text.name}, a line for each picture"
            )
        times.append(picture.t_us)
        pictures.append(picture.intensity[top : top + height, left : left + width].copy())
        region.append(float(picture.intensity[landmark].mean()) / STEPS_OF_8_BITS)
    if len(pictures) < 2:
        raise RecordingError(f"{path.name}: expected at least two full pictures, got {len(pictures)}")
    if stated is not None and len(stated) != len(pictures):
        raise RecordingError(
            f"{path.name}: expected a time for each of {len(pictures)} pictures, {text.name} has {len(stated)}"
        )
    t_us = np.array(times if stated is None else stated, np.float64)
    return IntensityCapture(check_times(t_us, path.name) + round(t_us[0]), np.stack(pictures), np.array(region))


def _frames(path: Path) -> Iterator[Picture]:
    """Frames of a video, with its times, or of a folder as grey pictures on the scale of a BIN file."""
    for frame in open_clip(path, ClipOptions(grey=True)).frames():
        grey = np.rint(frame.pixels[..., 0] * (255 * STEPS_OF_8_BITS)).astype(np.uint16)
        yield Picture(None if frame.t_us is None else round(frame.t_us), grey)


def reduced(crop: UInt16[np.ndarray, "h w"], config: RecordingsConfig) -> Float32[np.ndarray, "h2 w2"]:
    """The crop of a picture, averaged over areas to the final size, 0 to 255."""
    small = cv2.resize(crop.astype(np.float32), tuple(config.size[::-1]), interpolation=cv2.INTER_AREA)
    return small / np.float32(STEPS_OF_8_BITS)


def intensity_start_us(name: str, capture: IntensityCapture, config: RecordingsConfig) -> int:
    """Time of the first picture with a region mean below `dark_level` (paper, section 4); RecordingError if none."""
    dark = np.flatnonzero(capture.region < config.dark_level)
    if not len(dark):
        raise RecordingError(
            f"{name}: no picture is darker than {config.dark_level:g} in the landmark's region, the darkest has mean "
            f"{capture.region.min():.1f}; set the start by hand in {STARTS_FILE}, or recordings.dark_level"
        )
    if dark[0] == 0:
        raise RecordingError(
            f"{name}: the first picture is dark in the landmark's region already (mean {capture.region[0]:.1f}), so "
            f"its start cannot be told; set it by hand in {STARTS_FILE}, or move recordings.region"
        )
    return int(capture.t_us[dark[0]])


def event_start_us(name: str, events: Events, config: RecordingsConfig) -> int:
    """Time of negative event number `negative_events` in the region (paper, section 4); RecordingError if too few."""
    times = region_negative_times_us(events, config)
    if len(times) < config.negative_events:
        raise RecordingError(
            f"{name}: expected {config.negative_events} negative events in the landmark's region, got {len(times)}; "
            f"set the start by hand in {STARTS_FILE}, or recordings.negative_events"
        )
    return int(times[config.negative_events - 1])


def region_negative_times_us(events: Events, config: RecordingsConfig) -> Int64[Tensor, " n"]:
    """Times of the negative events in the landmark's region."""
    height, width = config.region
    return events.t[(events.p < 0) & (events.y < height) & (events.x >= events.width - width)]


def landmark_starts(target: Target, config: RecordingsConfig) -> dict[str, int]:
    """Start time of each capture by its own clock: given by hand, or when the landmark enters the region."""
    events, intensities, given = target.events, target.intensities, target.given
    starts = {name: event_start_us(name, one, config) for name, one in events.items() if name not in given}
    starts |= {name: intensity_start_us(name, one, config) for name, one in intensities.items() if name not in given}
    starts |= given
    return {name: starts[name] for name in (*events, *intensities)}
