"""Pictures of a simulation: the events of each channel between two true frames, beside S0 and DoLP."""

import functools
from collections.abc import Iterable, Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.font_manager import findfont
from matplotlib.ft2font import FT2Font
from torch import Tensor

from polarnet.events.representations import polarity_sums
from polarnet.events.stream import Events
from polarnet.reports.maps import DOLP_TABLE, dolp_image, event_full_scale, event_image, intensity_image
from polarnet.reports.videos import with_even_sides
from polarnet.stokes import POLARIZER_ANGLES_DEG

MIN_PANEL, MAX_PANEL = 240, 640  # pixels of a panel's longer side: small sensors are enlarged, large ones reduced
GAP, MARGIN = 8, 12
FONT_SIZE = 13  # pixels
LINE = 22  # height of a line of text
BAR = (10, 120)  # height and width of the colour bar of DoLP
TEXT_COLOUR = np.array([31, 35, 40], np.float32)
SCALE_INERTIA = 0.9  # share of the previous picture's full scale of events, which prevents flicker


class Preview:
    """Draws consecutive pictures of one simulation; keeps the scale of their events."""

    def __init__(self, height: int, width: int, gamma: float):
        """Pictures of channels of this size, S0 raised to 1 / `gamma`: 1 for code values, 2.2 for linear light."""
        longer = max(height, width)
        zoom = -(-MIN_PANEL // longer) if longer < MIN_PANEL else min(1.0, MAX_PANEL / longer)
        self._size = round(height * zoom), round(width * zoom)
        self._gamma = gamma
        self._scale: float | None = None

    def picture(
        self, channels: Sequence[Events], s0: Float[Tensor, "h w"], dolp: Float[Tensor, "h w"], span_us: tuple[int, int]
    ) -> UInt8[np.ndarray, "h2 w2 3"]:
        """The events of `span_us` (start and end), and S0 and DoLP at its end."""
        events = torch.stack([polarity_sums(channel) for channel in channels])
        present = event_full_scale(events)
        self._scale = present if self._scale is None else SCALE_INERTIA * self._scale + (1 - SCALE_INERTIA) * present
        maps = [event_image(image, self._scale) for image in events]
        captions = [f"events, {angle}°" for angle in POLARIZER_ANGLES_DEG]
        bright = intensity_image(s0.clamp(0, 1) ** (1 / self._gamma))
        rows = [
            self._row([*maps[:2], bright], [*captions[:2], "true S0"]),
            self._row([*maps[2:], dolp_image(dolp)], [*captions[2:], "true DoLP"]),
        ]
        width = rows[0].shape[1]
        start, stop = (time / 1000 for time in span_us)
        count = sum(map(len, channels))
        foot = self._foot(width, f"{start:.1f} to {stop:.1f} ms    {count:,} events    ON red, OFF blue")
        sheet = np.concatenate([rows[0], _white(GAP, width), rows[1], foot])
        return with_even_sides(np.pad(sheet, ((GAP, GAP), (MARGIN, MARGIN), (0, 0)), constant_values=255))

    def _row(self, maps: Iterable[np.ndarray], captions: Iterable[str]) -> UInt8[np.ndarray, "h2 w2 3"]:
        height, width = self._size
        parts = []
        for image, caption in zip(maps, captions, strict=True):
            enlarged = height > image.shape[0]
            method = cv2.INTER_NEAREST if enlarged else cv2.INTER_AREA
            panel = image if image.shape[:2] == self._size else cv2.resize(image, (width, height), interpolation=method)
            head = _white(LINE, width)
            _write(head, caption, 0)
            framed = panel.copy()
            framed[[0, -1]], framed[:, [0, -1]] = 200, 200  # white maps would have no edge
            parts += [np.concatenate([head, framed]), _white(LINE + height, GAP)]
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


def _white(height: int, width: int) -> UInt8[np.ndarray, "height width 3"]:
    return np.full((height, width, 3), 255, np.uint8)


def _write(picture: UInt8[np.ndarray, "h w 3"], text: str, left: int) -> None:
    """Draw a line of text into the picture, from the column `left`; what does not fit is cut off."""
    ink = _text(text)[: picture.shape[0], : picture.shape[1] - left, None]
    place = picture[: ink.shape[0], left : left + ink.shape[1]]
    place[:] = np.rint(place * (1 - ink) + TEXT_COLOUR * ink).astype(np.uint8)


@functools.lru_cache(maxsize=64)
def _text(text: str) -> Float[np.ndarray, "line w"]:
    """Coverage of each pixel of a line by the letters, in [0, 1]."""
    font = FT2Font(findfont("DejaVu Sans"))  # comes with matplotlib
    font.set_size(FONT_SIZE, 72)
    font.set_text(text, 0.0)
    font.draw_glyphs_to_bitmap(antialiased=True)
    ink = np.asarray(font.get_image()) / 255
    bottom = LINE - 6 + round(font.get_descent() / 64)
    line = np.zeros((LINE, ink.shape[1]))
    first = max(0, bottom - ink.shape[0])
    line[first : min(LINE, bottom)] = ink[ink.shape[0] - (bottom - first) :][: LINE - first]
    return line
