"""Command that exports a network."""

import argparse
from pathlib import Path

from polarnet.cli.parsers import Commands


def add_to(commands: Commands) -> None:
    """Add the command onnx."""
    onnx = commands.add_parser(
        "onnx",
        help="export a network as an ONNX file, checked with ONNX Runtime",
        description="The exported network takes the events of one window and a state, and returns DoLP and the new "
        "state; the file's metadata describes all inputs and outputs. The file is renamed to OUT.onnx once ONNX "
        "Runtime reproduces torch's outputs.",
        epilog="example: polarnet onnx polarnet.onnx --height 260 --width 346",
    )
    onnx.add_argument("file", type=Path, metavar="OUT.onnx", help="file to write")
    onnx.add_argument(
        "--weights", type=Path, metavar="FILE", help="checkpoint of the network (default: the shipped one)"
    )
    onnx.add_argument(
        "--height", type=int, default=120, help="sensor rows; the file works for this size only (default: 120)"
    )
    onnx.add_argument("--width", type=int, default=180, help="sensor columns (default: 180)")
    onnx.set_defaults(run=_onnx)


def _onnx(options: argparse.Namespace) -> int:
    from polarnet.networks.onnx_export import TOLERANCE, export_network
    from polarnet.networks.registry import load_network
    from polarnet.networks.weights import shipped_weights

    weights = options.weights or shipped_weights()
    export_network(*load_network(weights), options.file, options.height, options.width)
    size = options.file.stat().st_size / 1e6
    print(f"{weights} -> {options.file}, {size:.1f} MB; ONNX Runtime's outputs equal torch's within {TOLERANCE:g}")
    return 0
