"""Parts that the parsers of several commands share."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from polarnet.recordings.noise import Cleaning

READING_OPTIONS = ("format", "height", "width", "clock_mhz")
"""Options that describe a camera's file where the file itself does not."""

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""Object to which modules of commands add their parsers."""


def add_stored_sequence(command: argparse.ArgumentParser) -> None:
    """Add the positional arguments of an event store and one of its sequences."""
    command.add_argument("store", help="event store: folder or fsspec URL")
    command.add_argument("sequence", help="name of the sequence")


def add_hot_pixel_factor(command: argparse.ArgumentParser) -> None:
    """Add `--hot-pixel-factor`, the limit of `polarnet.recordings.noise.hot_pixels`."""
    command.add_argument(
        "--hot-pixel-factor",
        type=float,
        default=4.0,
        help="a pixel is hot above this multiple of the third busiest of the 5 x 5 pixels around it (default: 4)",
    )


def add_cleaning(command: argparse.ArgumentParser) -> None:
    """Add the options that remove noise from events, which `cleaning_of` reads."""
    command.add_argument(
        "--hot-pixels", metavar="found|FILE", help="remove hot pixels: found detects them, FILE has lines `x y`"
    )
    command.add_argument(
        "--background",
        metavar="TIME",
        help="remove each event before which no neighbouring pixel fired within TIME, such as 10ms",
    )
    add_hot_pixel_factor(command)


def cleaning_of(options: argparse.Namespace) -> "Cleaning":
    """Noise to remove; ValueError for a background that is not a time."""
    from polarnet.recordings.noise import FOUND, Cleaning

    within_us, hot = duration_us(options, "background", "10ms"), options.hot_pixels
    if hot not in (None, FOUND):
        hot = str(Path(hot).resolve())
        if not Path(hot).is_file():
            raise FileNotFoundError(f"--hot-pixels {options.hot_pixels}: expected {FOUND} or a file, there is none")
    return Cleaning(hot, options.hot_pixel_factor, within_us)


def duration_us(options: argparse.Namespace, name: str, example: str) -> int | None:
    """Option --NAME as a time in microseconds; None if it is not given, ValueError for anything but a time."""
    from polarnet.events.streaming import parse_window

    text = getattr(options, name)
    time_us, _ = parse_window(text) if text else (None, None)
    if text and time_us is None:
        raise ValueError(f"--{name}: expected a time such as {example}, got {text}")
    return time_us


def add_reading(command: argparse.ArgumentParser) -> None:
    """Add `READING_OPTIONS`."""
    command.add_argument("--format", help="format if it cannot be recognised: text, celex5_csv, celex5_bin, dat, ...")
    command.add_argument("--height", type=int, help="rows of the sensor, if the file does not state them")
    command.add_argument("--width", type=int, help="columns of the sensor, if the file does not state them")
    command.add_argument("--clock-mhz", type=float, help="clock of a CeleX-5 (default: 100)")


def reading_of(options: argparse.Namespace) -> dict[str, Any]:
    """Values of `READING_OPTIONS`."""
    return {name: getattr(options, name) for name in READING_OPTIONS}
