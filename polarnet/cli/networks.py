"""Command on a network: what others can run."""

import argparse
from pathlib import Path

from polarnet.cli.parsers import Commands


def add_to(commands: Commands) -> None:
    """Its commands."""
    onnx = commands.add_parser(
        "onnx",
        help="a network as an ONNX file, checked with ONNX Runtime",
        description="Writes one window of one stream: events and the state in, DoLP and the new state out. The file "
        "says in its metadata what these are; it gets its name once ONNX Runtime gives what torch gives.",
    )
    onnx.add_argument("file", type=Path, metavar="OUT.onnx")
    onnx.add_argument("--weights", type=Path, metavar="FILE", help="of the network; default: shipped")
    onnx.add_argument("--height", type=int, default=120, help="of the images, which the file is for alone (120)")
    onnx.add_argument("--width", type=int, default=180, help="(180)")
    onnx.set_defaults(run=_onnx)


def _onnx(options: argparse.Namespace) -> int:
    from polarnet.networks.checkpoint import load_network
    from polarnet.networks.onnx_export import TOLERANCE, export_network
    from polarnet.networks.weights import shipped_weights

    weights = options.weights or shipped_weights()
    found = export_network(*load_network(weights), options.file, options.height, options.width)
    worst = max(found, key=found.__getitem__)
    print(f"{weights} -> {options.file}, {options.file.stat().st_size / 1e6:.1f} MB")
    print(f"ONNX Runtime's outputs are within {found[worst]:.1e} of torch's ({worst}); {TOLERANCE:g} is allowed")
    return 0
