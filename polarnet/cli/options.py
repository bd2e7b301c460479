"""Values of the options that several commands share."""

import argparse
import functools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from polarnet.recordings.arrangements import Open
from polarnet.recordings.noise import FOUND, Cleaning
from polarnet.recordings.recording import open_recording

READING = ("part", "format", "height", "width")
"""Options that describe a camera's file, as arguments of `open_recording`."""
CLEANING = ("hot_pixels", "background")


def reading_of(options: argparse.Namespace) -> dict[str, Any]:
    """Values of `READING`."""
    return {name: getattr(options, name) for name in READING}


def opener_of(options: argparse.Namespace) -> Open:
    """`open_recording` with these values."""
    return functools.partial(open_recording, **reading_of(options))


def cleaning_of(options: argparse.Namespace) -> Cleaning:
    """Noise to remove; ValueError for a background that is not a time."""
    hot = options.hot_pixels
    if hot not in (None, FOUND):
        hot = str(Path(hot).resolve())
        if not Path(hot).is_file():
            raise FileNotFoundError(f"--hot-pixels {options.hot_pixels}: expected {FOUND} or a file, there is none")
    return Cleaning(hot, duration_us(options, "background", "10ms"))


def duration_us(options: argparse.Namespace, name: str, example: str) -> int | None:
    """Option --NAME as a time in microseconds; None if it is not given, ValueError for anything but a time."""
    text = getattr(options, name)
    if not text:
        return None
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*(us|ms|s)", text.strip())
    if match is None:
        raise ValueError(f"--{name}: expected a time such as {example}, got {text}")
    return round(float(match[1]) * {"us": 1, "ms": 1_000, "s": 1_000_000}[match[2]])


def given(options: argparse.Namespace, names: Sequence[str]) -> str:
    """Those of the options `names` that have a value, as on the command line: --size, --fps."""
    named = (name for name in names if getattr(options, name) is not None and getattr(options, name) is not False)
    return ", ".join(f"--{name.replace('_', '-')}" for name in named)


def refuse(options: argparse.Namespace, kind: str, names: Sequence[str]) -> None:
    """ValueError for a value of the options `names`, which have no meaning for inputs of a kind."""
    if listed := given(options, names):
        raise ValueError(f"{kind}: expected no {listed}, which does not apply to this input; leave it out")
