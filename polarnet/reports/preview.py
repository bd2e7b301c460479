"""Labelled pictures of a sequence, side by side (events, DoLP, AoLP, S0, polarization), and MP4 videos of them."""

import functools
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, TypeAlias

import av
import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from polarnet.events.representations import polarity_sums
from polarnet.events.stream import Events, slice_time
from polarnet.reports.maps import (
    DOLP_TABLE,
    angle_image,
    dolp_image,
    event_full_scale,
    event_image,
    intensity_image,
    polarization_hsv,
)
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.frames import Polarization
from polarnet.storage.true_frames import TrueFrames
from polarnet.terminal.progress import ProgressBar

CODEC, PIXELS = "libx264", "yuv420p"  # the one pair that every browser plays
QUALITY = {"preset": "ultrafast", "crf": "18", "threads": "1"}  # a second thread would take the network's core
LAYOUT = {"movflags": "hybrid_fragmented", "flush_packets": "1"}  # plays after a kill, an ordinary MP4 once closed
PICTURES_PER_SECOND = 30.0
SECONDS_PER_FRAGMENT = 2  # the most that a kill loses
MIN_PANEL, MAX_PANEL = 240, 640  # pixels of a panel's longer side: small sensors are enlarged, large ones reduced
GAP, MARGIN = 8, 12
FONT_SIZE = 13  # pixels
LINE = 22  # height of a line of text
BAR = (120, 10)  # width and height of the colour bar of DoLP
TEXT_COLOUR, EDGE_COLOUR = (31, 35, 40), (200, 200, 200)
SCALE_INERTIA = 0.9  # share of the previous picture's full scale of events, which prevents flicker
EMPTY = 60  # pixels between the text below a picture and the colour bar, or there is no bar

Captioned: TypeAlias = Mapping[str, UInt8[np.ndarray, "h w 3"]]  # maps of a row of a sheet, by caption


class VideoWriter:
    """Writes pictures of one size into an MP4; as a context manager it closes the file.

    Odd sides are made even by repeating the last row or column. After a kill, the file plays up to its last complete
    fragment. ValueError if a picture has another size than the first.

    >>> from pathlib import Path
    >>> import numpy as np
    >>> from polarnet.reports import VideoWriter
    >>> with VideoWriter(Path("grey.mp4"), rate_hz=30.0) as video:
    ...     for level in range(0, 250, 10):
    ...         video.add(np.full((32, 48, 3), level, np.uint8))
    """

    def __init__(self, path: Path, rate_hz: float):
        """`rate_hz` pictures a second; the file is created with the first picture."""
        self.path, self.rate = path, Fraction(rate_hz).limit_denominator(100_000)
        self._file: av.container.OutputContainer | None = None
        self._stream: Any = None

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, *problem: object) -> None:
        self.close()

    def add(self, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Add a picture in RGB."""
        even = with_even_sides(picture)
        if self._file is None:
            self._file = av.open(str(self.path), "w", format="mp4", options=LAYOUT)
            self._stream = self._file.add_stream(CODEC, rate=self.rate, options=QUALITY)
            self._stream.height, self._stream.width, self._stream.pix_fmt = *even.shape[:2], PIXELS
            self._stream.codec_context.gop_size = max(1, round(SECONDS_PER_FRAGMENT * self.rate))
        if even.shape[:2] != (self._stream.height, self._stream.width):
            expected = f"{self._stream.height} x {self._stream.width}"
            raise ValueError(f"{self.path}: expected pictures of {expected} px, got {even.shape[0]} x {even.shape[1]}")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
        self._file.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write the pictures that the encoder still holds, and the file's index."""
        if self._file is not None:
            self._file.mux(self._stream.encode())
            self._file.close()
            self._file = None


def with_even_sides(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The picture with its last row and column repeated where a side is odd, because codecs want even sides."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


class Sheet:
    """Draws the labelled pictures of one sequence; keeps the scale of their events from picture to picture."""

    def __init__(self, height: int, width: int):
        """Pictures of maps of this size; small maps are enlarged, large ones reduced."""
        longer = max(height, width)
        zoom = -(-MIN_PANEL // longer) if longer < MIN_PANEL else min(1.0, MAX_PANEL / longer)
        self._size = round(height * zoom), round(width * zoom)
        self._scale: float | None = None

    def events(self, sums: Float[Tensor, "n h w"]) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Maps of ON minus OFF events, coloured on one scale, which follows the number of events slowly."""
        present = event_full_scale(sums)
        inertia = 0.0 if self._scale is None else SCALE_INERTIA
        self._scale = inertia * (self._scale or 0.0) + (1 - inertia) * present
        return [event_image(image, self._scale) for image in sums]

    def picture(self, rows: Sequence[Captioned], foot: str) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Rows of captioned maps above a line of text and the colour bar of DoLP, with even sides."""
        height, width = self._size
        rows = [row for row in rows if row]
        columns = max(map(len, rows))
        below = GAP + len(rows) * (LINE + height + GAP)
        sheet = Image.new("RGB", (2 * MARGIN + columns * (width + GAP) - GAP, below + LINE + 6), "white")
        for row, maps in enumerate(rows):
            for column, (caption, image) in enumerate(maps.items()):
                left, top = MARGIN + column * (width + GAP), GAP + row * (LINE + height + GAP)
                sheet.paste(_line(caption, width), (left, top))
                sheet.paste(Image.fromarray(self._panel(image)), (left, top + LINE))
        self._foot(sheet, below - 2, foot)
        return with_even_sides(np.array(sheet))

    def truth(
        self, channels: Sequence[Events], truth: Polarization, span_us: tuple[int, int], gamma: float = 1.0
    ) -> UInt8[np.ndarray, "h2 w2 3"]:
        """The events of `span_us` (start and end) behind each polarizer, and the truth at its end.

        S0 is raised to 1 / `gamma`: 1 for code values, 2.2 for linear light.
        """
        maps = self.events(torch.stack([polarity_sums(channel) for channel in channels]))
        events = [(f"events, {angle}°", one) for angle, one in zip(POLARIZER_ANGLES_DEG, maps, strict=True)]
        bright = truth.s0.clamp(0, 1) ** (1 / gamma)
        above = {"true S0": intensity_image(bright), "true DoLP": dolp_image(truth.dolp)}
        below = {
            "true polarization and S0": polarization_hsv(bright, truth.dolp, truth.aolp),
            "true AoLP (hue), DoLP (saturation)": angle_image(truth.dolp, truth.aolp),
        }
        rows = [dict(events[:2]) | above, dict(events[2:]) | below]
        return self.picture(rows, foot_of(span_us, sum(map(len, channels))))

    def _panel(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        height, width = self._size
        method = cv2.INTER_NEAREST if height > image.shape[0] else cv2.INTER_AREA
        panel = cv2.resize(image, (width, height), interpolation=method)
        panel[[0, -1]], panel[:, [0, -1]] = EDGE_COLOUR, EDGE_COLOUR  # white maps would have no edge
        return panel

    def _foot(self, sheet: Image.Image, top: int, text: str) -> None:
        length, height = BAR
        zero, one = (round(_font().getlength(label)) for label in ("DoLP 0", "1"))
        left = sheet.width - MARGIN - one - 6 - length
        sheet.paste(_line(text, sheet.width - 2 * MARGIN), (MARGIN, top))
        if left - zero < MARGIN + _font().getlength(text) + EMPTY:
            return
        bar = Image.fromarray(DOLP_TABLE[None]).resize(BAR, Image.Resampling.NEAREST)
        sheet.paste(_line("DoLP 0", zero), (left - 6 - zero, top))
        sheet.paste(_line("1", one), (left + length + 4, top))
        sheet.paste(bar, (left, top + (LINE - height) // 2))


def write_true_video(
    path: Path, channels: Sequence[Events], truth: TrueFrames, gamma: float = 1.0
) -> UInt8[np.ndarray, "h w 3"] | None:
    """Write a picture (`Sheet.truth`) of each two true frames as a video of 30 a second, with a progress bar.

    Returns the picture with most events, None if there is none.

    >>> from pathlib import Path
    >>> import numpy as np
    >>> import torch
    >>> from polarnet.events import Events
    >>> from polarnet.reports import write_true_video
    >>> from polarnet.storage.frames import Polarization
    >>> from polarnet.storage.true_frames import TrueFrames
    >>> frame = Polarization(*torch.full((3, 20, 30), 0.5))
    >>> truth = TrueFrames(np.array([0, 33_333]), lambda start, stop: [frame] * (stop - start))
    >>> write_true_video(Path("grey.mp4"), [Events.empty(20, 30)] * 4, truth).dtype
    dtype('uint8')
    """
    sheet, busiest, most = Sheet(channels[0].height, channels[0].width), None, -1
    with VideoWriter(path, PICTURES_PER_SECOND) as video:
        for k in ProgressBar(range(1, len(truth)), "video", unit="picture"):
            span = int(truth.t_us[k - 1]), int(truth.t_us[k])
            window = [slice_time(events, *span) for events in channels]
            picture, count = sheet.truth(window, truth[k], span, gamma), sum(map(len, window))
            video.add(picture)
            if count > most:
                busiest, most = picture, count
    return busiest


def foot_of(span_us: tuple[int, int], count: int) -> str:
    """Line of text below a picture: the time span of its events, their number, and their colours."""
    start, stop = (time / 1000 for time in span_us)
    return f"{start:.1f} to {stop:.1f} ms    {count:,} events    ON red, OFF blue"


@functools.lru_cache(maxsize=64)
def _line(text: str, width: int) -> Image.Image:
    """A line of text, for reading only; what does not fit into the width is cut off."""
    line = Image.new("RGB", (width, LINE), "white")
    ImageDraw.Draw(line).text((0, LINE - 6), text, fill=TEXT_COLOUR, font=_font(), anchor="ls")  # on the base line
    return line


@functools.cache
def _font() -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(findfont("DejaVu Sans"), FONT_SIZE)  # comes with matplotlib
