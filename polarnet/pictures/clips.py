"""Clips: the frames of a video or of a folder, in colour or behind polarizers, one after another in constant memory."""

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, Shaped

from polarnet.pictures import images, polarimetry
from polarnet.pictures.images import UnreadablePicture, code_fractions, extension
from polarnet.pictures.polarimetry import MIN_MOSAIC_SIDE
from polarnet.stokes import Mosaic

VIDEOS = frozenset(["mp4", "m4v", "mov", "avi", "mkv", "webm", "mpg", "mpeg", "wmv", "gif"])
"""Lower-case extensions of files that are read as videos."""
TIMES_FILE = "timestamps.txt"
TIME_UNITS = {"us": 1.0, "ms": 1e3, "s": 1e6}
GREEN = 1  # polarization differs between colours, and this channel has the least noise

Size = tuple[int, int]
Levels = Shaped[np.ndarray, "channels h w"]


class ClipFrame(NamedTuple):
    """One frame, scaled to the size of its clip."""

    pixels: Float32[np.ndarray, "h w channels"]
    """RGB code values or light in [0, 1], or intensities at 0, 45, 90 and 135 degrees with I0 + I90 in [0, 1]."""
    t_us: float | None  # time that the video states
    saturated: float  # share of pixels with a saturated angle; 0 for RGB


@dataclass(frozen=True)
class ClipOptions:
    """How to read a clip."""

    mosaic: Mosaic | None = None  # angles over 2x2 pixels if the frames are raw mosaics
    white: float | None = None
    """Level at which the values of a polarization camera saturate; None: from the first frame."""
    grey: bool = False  # take colour frames as grey, without polarization
    size: Size | None = None
    """Height and width to scale to, after a centred cut to this aspect ratio; None: as they are."""


@dataclass(frozen=True)
class Clip:
    """Frames in the order of time."""

    name: str
    words: str  # kind of the frames, for messages
    measured: bool  # whether the channels of a frame are four polarizers, not RGB
    count: int | None  # number of frames; None: not known before the end
    still: bool  # whether the clip is a single picture or measurement; False for a video of one frame
    light: bool  # whether the RGB values are linear light in place of sRGB code values
    options: ClipOptions
    levels: Callable[[], Iterator[tuple[str, Levels, float | None]]]
    """Iterates from the first frame over name, code values and time (microseconds; None: unknown) of each frame."""

    def frames(self) -> Iterator[ClipFrame]:
        """Iterate from the first frame at each call; UnreadablePicture as `open_clip` says."""
        return _measured(self) if self.measured else _coloured(self)


def open_clip(path: Path, options: ClipOptions) -> Clip:
    """Open a video, a folder of frames, or the picture or measurement of a single frame.

    A folder whose files are all NAME_0, NAME_45, NAME_90, NAME_135 or .npz holds measured polarization, unless its
    numbers count frames; with a `mosaic`, a video or a folder holds raw mosaics. The frames of a folder follow the
    numbers in their names. FileNotFoundError or UnreadablePicture for files that are missing, damaged or do not belong
    together, on iterating for later frames.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file or folder")
    if path.is_dir():
        return _open_folder(path, path.resolve().name, options)
    if extension(path) not in VIDEOS:
        return _open_files([(path,)], path.stem, options)
    capture = _capture(path)
    stated = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    count, measured = stated if stated > 0 else None, options.mosaic is not None
    words = "raw mosaics" if measured else _coloured_words("video", options)
    return Clip(path.stem, words, measured, count, False, False, options, partial(_from_video, path, not measured))


def _open_folder(folder: Path, name: str, options: ClipOptions) -> Clip:
    kinds = images.picture_extensions() | {"npz"}
    visible = (path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    files = sorted((path for path in visible if extension(path) in kinds), key=_in_order)
    if not files:
        raise UnreadablePicture(f"{folder}: expected the pictures of a clip, found none; videos are given as files")
    groups = polarimetry.group_by_measurement(files)
    grouped = options.mosaic is None and polarimetry.are_measurements(groups)
    return _open_files(groups if grouped else [(file,) for file in files], name, options)


def _open_files(groups: Sequence[tuple[Path, ...]], name: str, options: ClipOptions) -> Clip:
    measured, still, light = extension(groups[0][0]) == "npz" or len(groups[0]) > 1, len(groups) == 1, False
    read: Callable[[tuple[Path, ...]], Levels]
    if measured:
        words, read = "four polarizers", polarimetry.read_levels
    elif options.mosaic is not None:
        words, read, measured = "raw mosaics", polarimetry.read_raw, True
    else:
        words = _coloured_words("photograph" if still else "frames", options)
        read = partial(_rgb, white=None if still else 1.0)
        light = images.holds_light(groups[0][0])
    return Clip(name, words, measured, len(groups), still, light, options, partial(_from_files, groups, read))


def _coloured_words(kind: str, options: ClipOptions) -> str:
    return f"{'grey' if options.grey else 'RGB'} {kind}"


def _from_files(
    groups: Sequence[tuple[Path, ...]], read: Callable[[tuple[Path, ...]], Levels]
) -> Iterator[tuple[str, Levels, None]]:
    for group in groups:
        try:
            yield group[0].name, read(group), None
        except UnreadablePicture as error:
            raise UnreadablePicture(f"{group[0].name}: {error}") from error


def _rgb(paths: tuple[Path, ...], white: float | None) -> Float32[np.ndarray, "3 h w"]:
    """sRGB code values, or light as shares of `white` (`images.light_of`); a picture with one channel is grey."""
    picture = images.read_picture(paths[0], grey=True)
    if picture.light:
        return images.light_of(picture.pixels, white).transpose(2, 0, 1)
    return images.srgb_of(code_fractions(picture.pixels), picture).transpose(2, 0, 1)


def _from_video(path: Path, colour: bool) -> Iterator[tuple[str, Levels, float]]:
    """Frames of a video: RGB in [0, 1] if `colour`, else green 8-bit levels."""
    opened = _capture(path)
    try:
        for number in itertools.count():
            there, pixels = opened.read()
            if not there:
                break
            if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
                raise UnreadablePicture(
                    f"{path.name}: expected frames of 3 x 8 bits, got {pixels.dtype} {pixels.shape}"
                )
            t_us = 1000 * opened.get(cv2.CAP_PROP_POS_MSEC)
            planes = code_fractions(pixels[..., ::-1].transpose(2, 0, 1)) if colour else pixels[None, ..., GREEN]
            yield f"frame {number}", planes, t_us
    finally:
        opened.release()
    if number == 0:
        raise UnreadablePicture(f"{path.name}: no frame of it can be read; convert it to MP4 or PNG files")


def _capture(path: Path) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise UnreadablePicture(f"{path.name}: OpenCV cannot open it as a video; convert it to MP4 or a folder of PNG")
    return capture


def _coloured(clip: Clip) -> Iterator[ClipFrame]:
    for rgb, t_us in _of_one_size(clip):
        pixels = np.ascontiguousarray(rgb.transpose(1, 2, 0))
        if clip.options.grey:
            pixels = np.repeat(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=-1)
        yield ClipFrame(_scaled(pixels, clip.options.size), t_us, 0.0)


def _measured(clip: Clip) -> Iterator[ClipFrame]:
    white, options = clip.options.white, clip.options
    for number, (levels, t_us) in enumerate(_of_one_size(clip)):
        try:
            white = polarimetry.white_level(levels, white)
        except UnreadablePicture as error:
            raise UnreadablePicture(f"frame {number}: {error}") from None
        height, width = levels.shape[1:]
        if len(levels) == 1 and (height % 2 or width % 2 or min(height, width) < MIN_MOSAIC_SIDE):
            raise UnreadablePicture(
                f"--mosaic: expected frames of even height and width, {MIN_MOSAIC_SIDE} px or more, for whole 2x2 "
                f"cells, got {height}x{width}; cut them without shifting the cells"
            )
        values, saturated = polarimetry.levels_at_angles(levels, white, options.mosaic)
        pixels = np.ascontiguousarray(values.astype(np.float32).transpose(1, 2, 0))
        yield ClipFrame(_scaled(pixels, options.size), t_us, float(saturated.any(0).mean()))


def _of_one_size(clip: Clip) -> Iterator[tuple[Levels, float | None]]:
    shape, first = None, ""
    for name, levels, t_us in clip.levels():
        if shape is None:
            shape, first = levels.shape, name
        if levels.shape != shape:
            sizes = [f"{s[1]}x{s[2]} px" + f", {s[0]} channels" * (s[0] != shape[0]) for s in (levels.shape, shape)]
            raise UnreadablePicture(f"{name}: expected frames of one size, got {sizes[0]} after {first} of {sizes[1]}")
        yield levels, t_us


def _scaled(pixels: Float32[np.ndarray, "h w c"], size: Size | None) -> Float32[np.ndarray, "h2 w2 c"]:
    if size is None:
        return pixels
    if size[0] > pixels.shape[0] or size[1] > pixels.shape[1]:
        height, width, _ = pixels.shape
        raise UnreadablePicture(f"--size: expected at most the frames' {height} {width}, got {size[0]} {size[1]}")
    return images.fit(pixels, *size, max_upscale=1.0)


def _in_order(path: Path) -> list[tuple[int, str]]:
    """Key that puts frame_2 before frame_10."""
    words = re.split(r"(\d+)", path.name)
    return [(int(word), "") if k % 2 else (0, word) for k, word in enumerate(words)]


def times_from_file(path: Path, unit: str) -> Float64[np.ndarray, " n"]:
    """Times in microseconds from a text with one a line, in `unit` (us, ms or s); further words and # are ignored."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file; write the time of each frame on a line of its own")
    times = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            times.append(float(words[0]) * TIME_UNITS[unit])
        except ValueError:
            raise ValueError(f"{path.name}, line {number}: expected a time in {unit}, got {words[0]!r}") from None
    return np.array(times)


def check_times(t_us: Float64[np.ndarray, " n"], source: str) -> Int64[np.ndarray, " n"]:
    """Times from the first frame's, in whole microseconds; ValueError if they do not increase by at least 1."""
    whole = np.rint(t_us - t_us[:1]).astype(np.int64) if np.isfinite(t_us).all() else np.full(len(t_us), -1)
    if (np.diff(whole) < 1).any():
        k = int((np.diff(whole) < 1).argmax())
        raise ValueError(
            f"{source}: expected times that increase by at least 1 us, got {t_us[k]:.10g} and {t_us[k + 1]:.10g} us "
            f"for frames {k} and {k + 1}; sort the frames, or name the unit with --time-unit"
        )
    return whole
