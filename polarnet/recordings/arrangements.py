"""Turn files of any polarizer arrangement into four channels on one clock.

An arrangement is either four files, one per angle and in any order (four cameras, or one camera four times), or one
file of a camera with a mosaic of polarizers on its pixels (division of focal plane). `polarnet.captures.targets`
handles division-of-time captures.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from polarnet.events.mosaic import split_mosaic
from polarnet.events.stream import Events, select
from polarnet.recordings.recording import Recording, read_recording
from polarnet.recordings.source import RecordingError
from polarnet.stokes import POLARIZER_ANGLES_DEG, Mosaic


def read_four(
    files: Mapping[int, str | os.PathLike[str]],
    start_us: Mapping[int, int] | None = None,
    read: Callable[[Path], Recording] = read_recording,
) -> list[Events]:
    """The four channels, in the order 0, 45, 90, 135 degrees, from files keyed by polarizer angle.

    Angles are in degrees and count modulo 180. `start_us` gives the start of the common clock in each file's own clock;
    earlier events are left out. Without it the files share one clock, whose time 0 is the earliest of all events.
    `read` replaces `read_recording` where a file needs options. RecordingError where an angle is missing or duplicated,
    or where the sensor sizes differ.

    >>> from pathlib import Path
    >>> from polarnet.recordings import read_four
    >>> size = Path("night.txt").write_text("40 30\\n0.5 3 2 1\\n")
    >>> [len(channel) for channel in read_four(dict.fromkeys((0, 45, 90, 135), "night.txt"))]
    [1, 1, 1, 1]
    """
    by_angle = {angle % 180: angle for angle in files}
    if sorted(by_angle) != list(POLARIZER_ANGLES_DEG) or len(by_angle) != len(files):
        raise RecordingError(f"expected one file for each of 0, 45, 90 and 135 degrees, got {sorted(files)}")
    if start_us is not None and set(start_us) != set(files):
        raise RecordingError(f"expected a start for each of the angles {sorted(files)}, got {sorted(start_us)}")
    channels = [read(Path(files[by_angle[angle]])).events for angle in POLARIZER_ANGLES_DEG]
    sizes = {(channel.height, channel.width) for channel in channels}
    if len(sizes) > 1:
        raise RecordingError(f"expected four files of one size of sensor, got {sorted(sizes)} (height, width)")
    if start_us is None:
        return _from_first_event(channels)
    starts = [start_us[by_angle[angle]] for angle in POLARIZER_ANGLES_DEG]
    return [shifted(select(c, c.t >= start), start) for c, start in zip(channels, starts, strict=True)]


def read_mosaic(
    path: str | os.PathLike[str], mosaic: Mosaic, read: Callable[[Path], Recording] = read_recording
) -> list[Events]:
    """The four channels (0, 45, 90, 135 degrees) of a file of a camera with a mosaic; time 0 is its first event.

    >>> from pathlib import Path
    >>> from polarnet.recordings import read_mosaic
    >>> size = Path("night.txt").write_text("40 30\\n0.5 3 2 1\\n")
    >>> [len(channel) for channel in read_mosaic("night.txt", ((90, 45), (135, 0)))]
    [0, 1, 0, 0]
    """
    return _from_first_event(split_mosaic(read(Path(path)).events, mosaic))


def read_plain(path: Path, read: Callable[[Path], Recording]) -> list[Events]:
    """One channel: all events of a camera without polarizers; time starts with its first event."""
    return _from_first_event([read(path).events])


def shifted(events: Events, origin_us: int) -> Events:
    """The same events, with `origin_us` as time 0."""
    return replace(events, t=events.t - origin_us)


def _from_first_event(channels: Sequence[Events]) -> list[Events]:
    """The channels, with time 0 at the earliest event of any of them."""
    start_us = min((int(channel.t[0]) for channel in channels if len(channel)), default=0)
    return [shifted(channel, start_us) for channel in channels]
