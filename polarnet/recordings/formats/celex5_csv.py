"""Event lists from the CeleX-5 vendor's converter: comma-separated whole numbers, the row first."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Int

from polarnet.events.stream import Events
from polarnet.recordings.formats.celex5 import HEIGHT, WHITE, WIDTH, microseconds, polarity_to_assume
from polarnet.recordings.formats.lines import HEAD_BYTES, lines_of, number_blocks, numbers_of
from polarnet.recordings.source import BLOCK_EVENTS, Block, Choices, RecordingError, Source, sensor_size

MODES = {
    3: "Event Off-Pixel Timestamp",  # row, column, t
    4: "Event In-Pixel Timestamp",  # row, column, t of the pixel, t of the readout
    5: "Event Intensity",  # row, column, intensity 0 to 4095, polarity -1, 0 or 1, t
}
"""The sensor's mode by the number of columns."""


def matches(path: Path, head: bytes) -> bool:
    """Whether the lines match one of the modes; four columns must not be `t,x,y,p`."""
    lines = [line.words for line in numbers_of(head)]
    if not lines or b"," not in head or len(lines[0]) not in MODES:
        return False
    last, second_last = zip(*(words[:-3:-1] for words in lines if len(words) == len(lines[0])), strict=True)
    if len(lines[0]) == 5:
        return _polarities(second_last)
    return len(lines[0]) == 3 or not _polarities(last)


def _polarities(words: tuple[str, ...]) -> bool:
    known = sum(word in ("-1", "0", "1") for word in words)
    return 2 * known > len(words)


def open_celex5_csv(path: Path, choices: Choices) -> Source:
    """Open a CSV file of any of the three modes; two of them have no polarity and are refused.

    Times are microseconds. Converters older than SDK 2.0 (December 2019) wrote the sensor's time stamps; `clock_mhz`
    selects this interpretation.
    """
    with path.open("rb") as file:
        lines = numbers_of(file.read(HEAD_BYTES))
    columns = len(lines[0].words) if lines else 5
    if columns not in MODES:
        raise RecordingError(
            f"{path.name}: expected the 5 columns row,col,adc,polarity,t of Event Intensity mode, or the 3 or 4 of the "
            f"other modes of a CeleX-5, got {columns}"
        )
    polarity = polarity_to_assume(path, MODES[columns], choices) if columns != 5 else 0
    height, width = sensor_size(path, choices, HEIGHT, WIDTH)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        for rows in number_blocks(path, (0,) * columns, 0, counts):
            if columns == 5:
                unchanged = rows[:, 3] == 0
                if unchanged.any():
                    counts["no_change"] += int(np.count_nonzero(unchanged))
                    rows = rows[~unchanged]
            row, column, *rest = np.ascontiguousarray(rows.T)
            p = rest[1] if columns == 5 else np.full(len(row), polarity, np.int8)
            t = rest[-1] if choices.clock_mhz is None else microseconds(rest[-1], choices.clock_mhz)
            yield Block(t, column, row, p)

    return Source(height, width, blocks)


def write_celex5_csv(path: Path, events: Events, intensity: Int[np.ndarray, " n"] | None = None) -> None:
    """Write events in the converter's Event Intensity format: lines row,col,adc,polarity,t in microseconds.

    `intensity` is the pixel's measurement, 0 to 4095; None writes half of the maximum. ValueError where events are not
    on the sensor of 800 x 1280.
    """
    if events.height > HEIGHT or events.width > WIDTH:
        raise ValueError(f"expected events of a sensor of {HEIGHT}x{WIDTH}, got {events.height}x{events.width}")
    adc = np.full(len(events), WHITE // 2) if intensity is None else np.asarray(intensity)
    if len(adc) != len(events) or (len(adc) and not (adc.min() >= 0 and adc.max() <= WHITE)):
        raise ValueError(f"expected an intensity of 0 to {WHITE} for each of {len(events)} events, got {len(adc)}")
    columns = [events.y.numpy(), events.x.numpy(), adc, events.p.numpy(), events.t.numpy()]
    with path.open("wb") as file:
        for start in range(0, len(events), BLOCK_EVENTS):
            part = [column[start : start + BLOCK_EVENTS] for column in columns]
            file.write(lines_of(np.stack(part, axis=1).astype(np.int64), ","))
