"""Labelled pictures of a sequence, side by side: events, DoLP, AoLP, S0 and polarization as hue, saturation, value."""

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

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
    EventScale,
    angle_image,
    dolp_image,
    event_image,
    intensity_image,
    polarization_hsv,
)
from polarnet.reports.videos import VideoWriter, with_even_sides
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.true_frames import TrueFrame, TrueFrames
from polarnet.terminal.progress import ProgressBar

MIN_PANEL, MAX_PANEL = 240, 640  # pixels of a panel's longer side: small sensors are enlarged, large ones reduced
GAP, MARGIN = 8, 12
FONT_SIZE = 13  # pixels
LINE = 22  # height of a line of text
TEXTS = 64  # drawn lines of text that are kept
BAR = (10, 120)  # height and width of the colour bar of DoLP
TEXT_COLOUR = np.array([31, 35, 40], np.float32)


Captioned: TypeAlias = Mapping[str, UInt8[np.ndarray, "h w 3"]]
"""Maps of a row of a sheet, by caption."""


class Sheet:
    """Draws the labelled pictures of one sequence; keeps the scale of their events from picture to picture."""

    def __init__(self, height: int, width: int):
        """Pictures of maps of this size; small maps are enlarged, large ones reduced."""
        longer = max(height, width)
        zoom = -(-MIN_PANEL // longer) if longer < MIN_PANEL else min(1.0, MAX_PANEL / longer)
        self._size = round(height * zoom), round(width * zoom)
        self._scale = EventScale()

    def events(self, sums: Float[Tensor, "n h w"]) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Maps of ON minus OFF events, coloured on one scale."""
        scale = self._scale.after(sums)
        return [event_image(image, scale) for image in sums]

    def picture(self, rows: Sequence[Captioned], foot: str) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Rows of captioned maps above a line of text and the colour bar of DoLP, with even sides."""
        drawn = [self._row(row) for row in rows if row]
        width = max(row.shape[1] for row in drawn)
        parts = [_widened(part, width) for row in drawn for part in (row, _white(GAP, width))]
        sheet = np.concatenate([*parts[:-1], self._foot(width, foot)])
        return with_even_sides(np.pad(sheet, ((GAP, GAP), (MARGIN, MARGIN), (0, 0)), constant_values=255))

    def truth(
        self, channels: Sequence[Events], truth: TrueFrame, span_us: tuple[int, int], gamma: float = 1.0
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

    def _row(self, maps: Captioned) -> UInt8[np.ndarray, "h2 w2 3"]:
        height, width = self._size
        parts = []
        for caption, image in maps.items():
            enlarged = height > image.shape[0]
            method = cv2.INTER_NEAREST if enlarged else cv2.INTER_AREA
            panel = image if image.shape[:2] == self._size else cv2.resize(image, (width, height), interpolation=method)
            framed = panel.copy()
            framed[[0, -1]], framed[:, [0, -1]] = 200, 200  # white maps would have no edge
            parts += [np.concatenate([_head(caption, width), framed]), _white(LINE + height, GAP)]
        return np.concatenate(parts[:-1], axis=1)

    def _foot(self, width: int, text: str) -> UInt8[np.ndarray, "h2 w2 3"]:
        foot = _white(LINE + 6, width)
        _write(foot[6:], text, 0)
        height, length = BAR
        bar = DOLP_TABLE[np.linspace(0, len(DOLP_TABLE) - 1, length).round().astype(int)]
        end = width - _text("1").shape[1] - 2
        top = 6 + (LINE - height) // 2
        left = end - 4 - length
        if left > _text(text).shape[1] + 60:
            foot[top : top + height, left : left + length] = bar
            _write(foot[6:], "1", end)
            _write(foot[6:], "DoLP 0", left - 6 - _text("DoLP 0").shape[1])
        return foot


def true_pictures(
    channels: Sequence[Events], truth: TrueFrames, gamma: float = 1.0
) -> Iterator[tuple[UInt8[np.ndarray, "h w 3"], int]]:
    """Yield a picture (`Sheet.truth`) and the number of events between each two true frames, with a progress bar."""
    sheet = Sheet(channels[0].height, channels[0].width)
    for k in ProgressBar(range(1, len(truth)), "video", unit="picture"):
        span = int(truth.t_us[k - 1]), int(truth.t_us[k])
        window = [slice_time(events, *span) for events in channels]
        yield sheet.truth(window, truth[k], span, gamma), sum(map(len, window))


def write_true_video(
    path: Path, channels: Sequence[Events], truth: TrueFrames, rate_hz: float = 30.0, gamma: float = 1.0
) -> UInt8[np.ndarray, "h w 3"] | None:
    """Write the pictures of `true_pictures` as a video; returns the one with most events, None if there is none.

    >>> from pathlib import Path
    >>> import numpy as np
    >>> import torch
    >>> from polarnet.events import Events
    >>> from polarnet.reports import write_true_video
    >>> from polarnet.storage.true_frames import TrueFrame, TrueFrames
    >>> frame = TrueFrame(*torch.full((3, 20, 30), 0.5))
    >>> truth = TrueFrames(np.array([0, 33_333]), lambda start, stop: [frame] * (stop - start))
    >>> write_true_video(Path("grey.mp4"), [Events.empty(20, 30)] * 4, truth).dtype
    dtype('uint8')
    """
    busiest, most = None, -1
    with VideoWriter(path, rate_hz) as video:
        for picture, count in true_pictures(channels, truth, gamma):
            video.add(picture)
            if count > most:
                busiest, most = picture, count
    return busiest


def foot_of(span_us: tuple[int, int], count: int) -> str:
    """Line of text below a picture: the time span of its events, their number, and their colours."""
    start, stop = (time / 1000 for time in span_us)
    return f"{start:.1f} to {stop:.1f} ms    {count:,} events    ON red, OFF blue"


def _white(height: int, width: int) -> UInt8[np.ndarray, "height width 3"]:
    return np.full((height, width, 3), 255, np.uint8)


@functools.lru_cache(maxsize=TEXTS)
def _head(caption: str, width: int) -> UInt8[np.ndarray, "height width 3"]:
    """The caption above a panel, for reading only."""
    head = _white(LINE, width)
    _write(head, caption, 0)
    head.setflags(write=False)
    return head


def _widened(part: UInt8[np.ndarray, "h w 3"], width: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    return np.pad(part, ((0, 0), (0, width - part.shape[1]), (0, 0)), constant_values=255)


def _write(picture: UInt8[np.ndarray, "h w 3"], text: str, left: int) -> None:
    """Draw a line of text into the picture, from the column `left`; what does not fit is cut off."""
    ink = _text(text)[: picture.shape[0], : picture.shape[1] - left, None]
    place = picture[: ink.shape[0], left : left + ink.shape[1]]
    place[:] = np.rint(place * (1 - ink) + TEXT_COLOUR * ink).astype(np.uint8)


@functools.lru_cache(maxsize=TEXTS)
def _text(text: str) -> Float[np.ndarray, "line w"]:
    """Coverage of each pixel of a line by the letters, in [0, 1]."""
    font = ImageFont.truetype(findfont("DejaVu Sans"), FONT_SIZE)  # comes with matplotlib
    line = Image.new("L", (math.ceil(font.getlength(text)), LINE))
    ImageDraw.Draw(line).text((0, LINE - 6), text, fill=255, font=font, anchor="ls")  # its base line above the edge
    return np.asarray(line) / 255
