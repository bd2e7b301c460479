"""Formats that the package faery reads: AEDAT4 of iniVation, EVT2, EVT2.1 and EVT3 of Prophesee, Event Stream."""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from polarnet.recordings.source import Block, Choices, RecordingError, Source, sensor_size

AEDAT4 = b"#!AER-DAT4"
EVENT_STREAM = b"Event Stream"
LONGEST_HEADER = 2**16
GATHERED_EVENTS = 2**16
SENSORS = {b"gen3": (480, 640), b"gen4": (720, 1280), b"imx636": (720, 1280), b"genx320": (320, 320)}
"""Height and width of Prophesee's sensors by what the header's plugin is called; files of 2020 say nothing else."""


def matches_aedat4(path: Path, head: bytes) -> bool:
    """By its first bytes."""
    return head.startswith(AEDAT4)


def matches_event_stream(path: Path, head: bytes) -> bool:
    """By its first bytes."""
    return head.startswith(EVENT_STREAM)


def matches_evt(path: Path, head: bytes) -> bool:
    """By its header's lines."""
    return head.startswith(b"% ") and (b"% evt " in head or b"% format EVT" in head)


def open_aedat4(path: Path, choices: Choices) -> Source:
    """The first stream of events of the file; its times are microseconds since 1970."""
    return _source(path, choices, {"file_type": "aedat"}, states_size=True)


def open_event_stream(path: Path, choices: Choices) -> Source:
    """The changes of a DVS or ATIS."""
    return _source(path, choices, {"file_type": "es"}, states_size=True)


def open_evt(path: Path, choices: Choices) -> Source:
    """EVT2, EVT2.1 or EVT3; the size of the sensor from the header, or from the name of its sensor there."""
    with path.open("rb") as file:
        header = re.split(rb"\n(?!% )", file.read(LONGEST_HEADER), maxsplit=1)[0]
    version = re.search(rb"% evt (\d\.\d)|% format EVT(\d(?:\.\d)?)", header)
    if version is None:
        raise RecordingError(f"{path.name}: its header of % lines does not say which EVT it is")
    number = (version[1] or version[2]).decode().removesuffix(".0")
    if number not in ("2", "2.1", "3"):
        raise RecordingError(f"{path.name}: expected EVT 2, 2.1 or 3, got {number}")
    height, width = sensor_size(path, choices, *_size(header))
    options = {"file_type": "evt", "version_fallback": f"evt{number}", "dimensions_fallback": (width, height)}
    return _source(path, Choices(height, width), options, states_size=False)


def _size(header: bytes) -> tuple[int | None, int | None]:
    if found := re.search(rb"% geometry (\d{1,5})x(\d{1,5})", header):
        return int(found[2]), int(found[1])
    height, width = (re.search(name + rb"=(\d{1,5})", header) for name in (b"height", b"width"))
    if height and width:
        return int(height[1]), int(width[1])
    for name, size in SENSORS.items():
        if re.search(rb"% (plugin_name|sensor_name|integrator_name)[^\n]*" + name, header):
            return size
    return None, None


def _source(path: Path, choices: Choices, options: dict[str, Any], *, states_size: bool) -> Source:
    width, height = _guarded(path, lambda: _decoder(path, options).dimensions()) if states_size else (None, None)
    height, width = sensor_size(path, choices, height, width)

    def blocks(counts: Counter[str]) -> Iterator[Block]:
        packets = iter(_guarded(path, lambda: _decoder(path, options)))
        waiting, count = [], 0  # packets are small
        while (packet := _guarded(path, lambda: next(packets, None))) is not None:
            waiting.append(packet)
            count += len(packet)
            if count >= GATHERED_EVENTS:
                yield _block(waiting)
                waiting, count = [], 0
        if count:
            yield _block(waiting)

    return Source(height, width, blocks)


def _block(packets: list[np.ndarray]) -> Block:
    joined = np.concatenate(packets)
    return Block(joined["t"], joined["x"], joined["y"], joined["on"].view(np.uint8))


def _decoder(path: Path, options: dict[str, Any]) -> Any:
    try:
        import faery
    except ImportError:
        raise RuntimeError(f"{path.name}: this format needs faery: pip install 'polarnet[recordings]'") from None
    return faery.events_stream_from_file(path, **options)


def _guarded(path: Path, call: Any) -> Any:
    """What faery answers; whatever it raises about a damaged file becomes a RecordingError."""
    try:
        return call()
    except (RuntimeError, RecordingError) as error:
        if isinstance(error.__context__, ImportError):
            raise
        raise RecordingError(f"{path.name}: faery cannot read it: {error}") from error
    except BaseException as error:  # a panic of its Rust code is no Exception
        if isinstance(error, (KeyboardInterrupt, SystemExit, GeneratorExit)):
            raise
        raise RecordingError(f"{path.name}: faery cannot read it: {error}") from error
