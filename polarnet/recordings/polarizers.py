"""Check whether four channels look like one scene behind polarizers at 0, 45, 90 and 135 degrees.

Behind ideal polarizers I0 + I90 = I45 + I135. To first order, events obey it too: summed over a small area and a short
time, ON minus OFF events of 0 and 90 degrees equal those of 45 and 135. The two other pairings of the four channels
differ by the polarization. The pairs that fit best are therefore at right angles. Channels that differ neither in
counts nor between pairings saw no polarization.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Float64

from polarnet.events.stream import Events, concatenate, slice_time
from polarnet.events.streaming import TRAINED_WINDOW_US
from polarnet.recordings.arrangements import Piece
from polarnet.recordings.noise import event_counts, hot_pixels, without_pixels
from polarnet.stokes import POLARIZER_ANGLES_DEG

WINDOWS = 30  # the first second
BLOCK = 4  # pixels, square; single pixels have too few events to compare
MIN_BLOCKS = 1000  # blocks with events: the ratio of two misfits is then known to about 1 / sqrt(1000), 3 %
DISTURBING_HZ = 10_000.0  # events a second of a pixel; more change the shipped network's DoLP far from the pixel

# Limits of misfits and counts (docs/recover.md, section Checks)
BETTER_FIT = 0.9  # misfit of other pairs over that of the pairs at right angles: lower only where the order is wrong
EQUAL_COUNTS = 1.1  # events of the busiest channel over those of the quietest: lower without polarization
EQUAL_MISFITS = 1.1  # misfit of other pairs over that of the pairs at right angles: lower without polarization ...
EQUAL_MISFITS_MOSAIC = 3.5  # ... and in a mosaic, whose four pixels look at places half a cell apart

PAIRS = (((0, 90), (45, 135)), ((0, 45), (90, 135)), ((0, 135), (45, 90)))
"""The three pairings of the four angles; the first pairs polarizers at right angles."""
EXCHANGED = ((45, 90), (90, 135))
"""Angles to exchange where the second or the third of `PAIRS` fits best, so that the first does."""


class ChannelCheck:
    """Examines a recording's pieces as they pass through `watch`, and reports problems in `findings`."""

    def __init__(self, height: int, width: int, *, mosaic: bool):
        self.counts = [0, 0, 0, 0]
        """Number of events in each channel."""
        self._mosaic = mosaic
        self._early: list[list[Events]] = [[Events.empty(height, width)] for _ in POLARIZER_ANGLES_DEG]
        self._windows = 0  # of the first second, whose events have all arrived

    def watch(self, pieces: Iterable[Piece]) -> Iterator[Piece]:
        """Pass the pieces on unchanged, keeping the events of the first second."""
        for piece in pieces:
            self.counts = [n + len(events) for n, events in zip(self.counts, piece.channels, strict=True)]
            if self._windows < WINDOWS:
                for parts, events in zip(self._early, piece.channels, strict=True):
                    parts.append(slice_time(events, 0, WINDOWS * TRAINED_WINDOW_US))
                self._windows = min(piece.until_us // TRAINED_WINDOW_US, WINDOWS)
            yield piece

    def findings(self) -> list[str]:
        """Problems found, a sentence each; empty if there are none, or too few events to judge."""
        stop_us = self._windows * TRAINED_WINDOW_US
        seconds = stop_us * 1e-6
        early = [slice_time(concatenate(parts), 0, stop_us) for parts in self._early]
        counts = np.stack([*map(event_counts, early)])
        hot = np.stack([hot_pixels(count, seconds) for count in counts])
        findings = _channel_findings(*pair_misfits([*map(without_pixels, early, hot)]), self.counts, self._mosaic)
        if disturbing := int((hot & (counts > DISTURBING_HZ * seconds)).sum()):
            findings.append(
                f"Hot pixels with more than {DISTURBING_HZ:,.0f} events a second: {disturbing}. DoLP is wrong in the "
                f"whole image; remove them with --hot-pixels found, or for a live camera with --hot-pixels FILE."
            )
        return findings


def _channel_findings(
    misfits: Float64[np.ndarray, " 3"], blocks: int, counts: Sequence[int], mosaic: bool
) -> list[str]:
    """Problems shown by `pair_misfits` and the counts of the channels; empty without enough evidence."""
    silent = [f"{angle}" for angle, count in zip(POLARIZER_ANGLES_DEG, counts, strict=True) if count == 0]
    if silent:
        return [f"There are no events behind the polarizer at {' and '.join(silent)} degrees. DoLP and AoLP are wrong."]
    if blocks < MIN_BLOCKS:
        return []
    if not misfits.any():
        return ["The four channels are the same, event by event: one recording was given four times."]
    if not misfits[0]:
        return []
    ratio = misfits / misfits[0]
    spread = max(counts) / min(counts)
    if spread < EQUAL_COUNTS and ratio.max() < (EQUAL_MISFITS_MOSAIC if mosaic else EQUAL_MISFITS):
        return [
            f"The four channels show the same: their numbers of events differ by {spread - 1:.1%}, and their sums "
            f"fit each other in any pairs. Either the recording was made without polarizers, or its scene is "
            f"hardly polarized (a DoLP below about 0.1); events cannot tell which. Without polarizers, DoLP and "
            f"AoLP mean nothing."
        ]
    best = int(ratio.argmin())
    if ratio[best] < BETTER_FIT:
        (a, b), (c, d) = PAIRS[best]
        one, other = EXCHANGED[best - 1]
        return [
            f"The polarizers seem to be in another order: I0 + I90 = I45 + I135 does not hold. {a} and {b}, {c} "
            f"and {d} degrees fit better as pairs at right angles, with {ratio[best]:.0%} of the misfit. "
            f"DoLP and AoLP are wrong; exchange {one} and {other} in --mosaic or --angles."
        ]
    return []


def pair_misfits(channels: Sequence[Events]) -> tuple[Float64[np.ndarray, " 3"], int]:
    """Root mean square difference between the sums of each of `PAIRS` of channels in the first second.

    The sums are ON minus OFF events per block and window. The second value is the number of blocks with events. OFF
    events are weighted so that all ON and OFF events cancel, since the two thresholds may differ.
    """
    on = sum(int((events.p > 0).sum()) for events in channels)
    off = sum(map(len, channels)) - on
    columns = -(-channels[0].width // BLOCK)
    blocks = -(-channels[0].height // BLOCK) * columns
    place = [
        (e.t // TRAINED_WINDOW_US * blocks + e.y.long() // BLOCK * columns + e.x // BLOCK).numpy() for e in channels
    ]
    weights = [np.where(e.p.numpy() > 0, 1.0, -on / max(off, 1)) for e in channels]
    sums = dict(zip(POLARIZER_ANGLES_DEG, map(np.bincount, place, weights, [WINDOWS * blocks] * 4), strict=True))
    squares = [((sums[a] + sums[b] - sums[c] - sums[d]) ** 2).sum() for (a, b), (c, d) in PAIRS]
    lit = int(np.count_nonzero(np.bincount(np.concatenate(place))))
    return np.sqrt(np.array(squares) / max(lit, 1)), lit
