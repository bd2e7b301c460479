"""Event lists from the CeleX-5 vendor's converter: comma-separated whole numbers, the row first."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polarnet.recordings.formats.celex5_bin import HEIGHT, WIDTH, microseconds, no_polarity
from polarnet.recordings.formats.lines import HEAD_BYTES, number_blocks, numbers_of
from polarnet.recordings.source import Block, Choices, RecordingError, Source, sensor_size

MODES = {
    3: "Event Off-Pixel Timestamp",  # row, column, t
    4: "Event In-Pixel Timestamp",  # row, column, t of the pixel, t of the readout
    5: "Event Intensity",  # row, column, intensity 0 to 4095, polarity -1, 0 or 1, t
}
"""The sensor's mode by the number of columns."""


def matches(path: Path, head: bytes) -> bool:
    """Whether the columns are those of a mode; four columns that end with a polarity are `t,x,y,p` and do not match."""
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
    """Open a CSV file of Event Intensity mode; the other two modes have no polarity and are refused.

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
    if columns != 5:
        raise no_polarity(path, MODES[columns])
    height, width = sensor_size(path, choices, HEIGHT, WIDTH)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        for rows in number_blocks(path, (0,) * columns, 0, counts):
            unchanged = rows[:, 3] == 0
            if unchanged.any():
                counts["no_change"] += int(np.count_nonzero(unchanged))
                rows = rows[~unchanged]
            row, column, _, p, t = np.ascontiguousarray(rows.T)
            yield Block(t if choices.clock_mhz is None else microseconds(t, choices.clock_mhz), column, row, p)

    return Source(height, width, blocks)
