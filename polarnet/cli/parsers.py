"""Parts that the parsers of several commands share."""

import argparse
from typing import TypeAlias

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""Object to which modules of commands add their parsers."""


def add_stored_sequence(command: argparse.ArgumentParser) -> None:
    """Add the positional arguments of an event store and one of its sequences."""
    command.add_argument("store", help="event store: folder or fsspec URL")
    command.add_argument("sequence", help="name of the sequence")


def add_hot_pixel_factor(command: argparse.ArgumentParser) -> None:
    """Add `--hot-pixel-factor`, the limit of `polarnet.recordings.pixels.hot_pixels`."""
    command.add_argument(
        "--hot-pixel-factor",
        type=float,
        default=4.0,
        help="a pixel is hot above this multiple of the third busiest of the 5 x 5 pixels around it (default: 4)",
    )
