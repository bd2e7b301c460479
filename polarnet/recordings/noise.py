"""Remove noise from events before recovery: those of hot pixels, and background activity.

Hot pixels fire far more often than their neighbours. Background activity is events that no neighbour supports: an edge
that moves over a pixel moves over the pixels around it too (Delbruck, "Frame-free dynamic digital vision", 2008).
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Int

from polarnet.events.stream import Events, places_of, select
from polarnet.recordings.arrangements import Piece
from polarnet.runtime.compilation import compiled
from polarnet.stokes import Mosaic

FOUND = "found"
NEVER = np.iinfo(np.int64).min // 2

NEIGHBOURHOOD = 5  # side of a square, in pixels
HOT_FACTOR = 4.0
MIN_HOT_HZ = 20.0  # slower pixels are harmless in a scene
MIN_EVENTS = 8  # fewer events are no evidence


class Cleaning(NamedTuple):
    """Noise to remove, as the user asks for it."""

    hot: str | None
    """File with a line `x y` for each hot pixel of the sensor; `FOUND`: detect hot pixels; None: keep them."""
    background_us: int | None
    """Time before an event in which one of the 8 pixels around it must fire, else it is removed; None: no removal."""


class Cleaner:
    """Removes noise from the pieces of a recording; `removed` counts the events, `hot` the hot pixels.

    `mosaic` is the arrangement of the sensor's polarizers, whose channels have half its rows and columns; None if each
    channel has its own sensor.
    """

    def __init__(self, cleaning: Cleaning, mosaic: Mosaic | None):
        self.removed = {"hot pixels": 0, "background activity": 0}
        self.hot = 0
        self._cleaning, self._mosaic = cleaning, mosaic

    def clean(self, pieces: Iterable[Piece], *, live: bool = False) -> Iterator[Piece]:
        """The pieces without noise. Hot pixels are found in a first pass over them: ValueError for live input."""
        if live and self._cleaning.hot == FOUND:
            raise ValueError(f"--hot-pixels {FOUND}: expected a file of hot pixels for live input, `x y` a line")
        return self._cleaned(pieces)

    def _cleaned(self, pieces: Iterable[Piece]) -> Iterator[Piece]:
        bad = self._found(pieces) if self._cleaning.hot == FOUND else None
        last: list[np.ndarray] = []
        for piece in pieces:
            if not last:
                bad = bad or [self._listed(events, k) for k, events in enumerate(piece.channels)]
                self.hot = sum(int(one.sum()) for one in bad)
                last = [never(events) for events in piece.channels]
            clean = list(map(without_pixels, piece.channels, bad or []))
            self.removed["hot pixels"] += sum(map(len, piece.channels)) - sum(map(len, clean))
            if (within_us := self._cleaning.background_us) is not None:
                quiet = [without_background(events, within_us, one) for events, one in zip(clean, last, strict=True)]
                self.removed["background activity"] += sum(map(len, clean)) - sum(map(len, quiet))
                clean = quiet
            yield piece._replace(channels=clean)

    def sentence(self) -> str:
        """Number of removed events of each kind, in words."""
        wanted = {"hot pixels": self._cleaning.hot, "background activity": self._cleaning.background_us}
        return ", ".join(
            f"{count:,} events of {f'{self.hot} ' if kind == 'hot pixels' else ''}{kind}"
            for kind, count in self.removed.items()
            if wanted[kind] is not None
        )

    def _found(self, pieces: Iterable[Piece]) -> list[Bool[np.ndarray, "h w"]]:
        """Hot pixels of each channel of a whole recording; none if it has no event."""
        counts: Sequence[np.ndarray] = []
        duration_us = 0
        for piece in pieces:
            new = list(map(event_counts, piece.channels))
            counts = list(map(np.add, counts, new)) if counts else new
            duration_us = piece.until_us
        return [hot_pixels(one, duration_us * 1e-6) for one in counts]

    def _listed(self, events: Events, channel: int) -> Bool[np.ndarray, "h w"]:
        """Hot pixels of a channel in the user's list."""
        if self._cleaning.hot is None:
            return np.zeros((events.height, events.width), bool)
        cell = 1 if self._mosaic is None else 2
        listed = read_hot_pixels(Path(self._cleaning.hot), cell * events.height, cell * events.width)
        if self._mosaic is None:
            return listed
        row, column = places_of(self._mosaic)[channel]
        return listed[row::2, column::2]


def event_counts(events: Events) -> Int[np.ndarray, "h w"]:
    """Number of events of each pixel."""
    pixel = events.y.long() * events.width + events.x.long()
    counts = torch.bincount(pixel, minlength=events.height * events.width)
    return counts.view(events.height, events.width).numpy()


def hot_pixels(
    counts: Int[np.ndarray, "h w"], duration_s: float, factor: float | int = HOT_FACTOR, min_hz: float = MIN_HOT_HZ
) -> Bool[np.ndarray, "h w"]:
    """Pixels that fired more than `factor` times as often as the third busiest of the 5x5 pixels around them.

    `counts` are the events of each pixel in `duration_s`. The third busiest is the reference so that thin lines and
    their ends are not hot, but two hot neighbours are. Pixels with less than `min_hz`, or 8 events, never are.
    """
    border = NEIGHBOURHOOD // 2
    around = np.lib.stride_tricks.sliding_window_view(np.pad(counts, border), (NEIGHBOURHOOD, NEIGHBOURHOOD))
    hot = (counts >= MIN_EVENTS) & (counts > min_hz * duration_s)
    third = np.partition(around[hot].reshape(-1, NEIGHBOURHOOD**2), -3, axis=-1)[:, -3]
    hot[hot] = counts[hot] > factor * third
    return hot


def without_pixels(events: Events, bad: Bool[np.ndarray, "h w"]) -> Events:
    """The events of all pixels outside `bad`."""
    if not bad.any():
        return events
    return select(events, ~torch.from_numpy(bad)[events.y.long(), events.x.long()])


def read_hot_pixels(path: Path, height: int, width: int) -> Bool[np.ndarray, "h w"]:
    """Pixels listed in a text file, `x y` a line; ValueError for other lines and for pixels that are off the sensor."""
    bad = np.zeros((height, width), bool)
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        if len(words) != 2 or not all(word.isdigit() for word in words):
            raise ValueError(f"{path.name}, line {number}: expected `x y` of a hot pixel, got {line!r}")
        x, y = map(int, words)
        if x >= width or y >= height:
            raise ValueError(f"{path.name}, line {number}: pixel {x} {y} is not on the sensor of {height}x{width} px")
        bad[y, x] = True
    return bad


def write_hot_pixels(path: Path, hot: Bool[np.ndarray, "h w"]) -> None:
    """Write the file that `read_hot_pixels` reads."""
    path.write_text("".join(f"{x} {y}\n" for y, x in np.argwhere(hot)), encoding="utf-8")


def without_background(events: Events, within_us: int, last_us: np.ndarray) -> Events:
    """Events that a neighbour supports: one of the 8 pixels around fired at most `within_us` before.

    `last_us` holds the time of each pixel's last event with a border of one pixel, and is updated, so that a stream can
    come in pieces; see `never`.
    """
    keep = _supported(events.t.numpy(), events.x.numpy(), events.y.numpy(), within_us, last_us)
    return select(events, torch.from_numpy(keep))


def never(events: Events) -> np.ndarray:
    """`last_us` of `without_background` before the first event."""
    return np.full((events.height + 2, events.width + 2), NEVER)


@compiled
def _supported(t, x, y, within_us, last):
    keep = np.zeros(len(t), np.bool_)
    for i in range(len(t)):
        row, column = np.int64(y[i]) + 1, np.int64(x[i]) + 1
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                if (dy != 0 or dx != 0) and t[i] - last[row + dy, column + dx] <= within_us:
                    keep[i] = True
        last[row, column] = t[i]
    return keep
