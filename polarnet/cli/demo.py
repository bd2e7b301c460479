"""Command that shows a first result: a built-in photograph, simulated and recovered with the shipped weights."""

import argparse
import time
from pathlib import Path

from polarnet.cli.parsers import Commands

PHOTOGRAPHS = ("astronaut", "chelsea", "coffee", "motorcycle_left")
"""Photographs of scikit-image that fill the sensor with colour."""


def add_to(commands: Commands) -> None:
    """Add the command demo."""
    demo = commands.add_parser(
        "demo",
        help="a first result in a minute: simulate a built-in photograph and recover its DoLP",
        description="Simulates a camera with four polarizers that moves over a photograph of scikit-image, and "
        "recovers DoLP and AoLP from its events with the shipped weights. Trains nothing and downloads nothing. "
        "`polarnet simulate` and `polarnet recover` do the two halves, on files of your own.",
        epilog="example: polarnet demo --photograph coffee sensor=noisy",
    )
    demo.add_argument("--photograph", choices=PHOTOGRAPHS, default=PHOTOGRAPHS[0], help="default: astronaut")
    demo.add_argument("--out", type=Path, metavar="FOLDER", default=Path("outputs/demo"), help="default: outputs/demo")
    demo.add_argument("overrides", nargs="*", help="values that replace those of params.yaml: sensor=noisy seed=2")
    demo.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> int:
    from polarnet.cli import main
    from polarnet.pictures.builtin import BUILTIN_PHOTOS

    started = time.monotonic()
    photograph = next(photo.path for photo in BUILTIN_PHOTOS if photo.path.stem == options.photograph)
    simulated, recovered = (options.out.resolve() / name for name in ("simulated", "recovered"))
    print(f"simulating {photograph.name}; the first run also compiles the simulation")
    status = main(["simulate", str(photograph), *options.overrides, "--out", str(simulated)])
    status = status or main(["recover", str(simulated / "events.zarr"), "--out", str(recovered)])
    if status == 0:
        print(f"video       {recovered / 'recovered.mp4'}\ntruth       {simulated / 'preview.mp4'}")
        print(f"done in     {time.monotonic() - started:.0f} s; open {recovered / 'index.html'}")
    return status
