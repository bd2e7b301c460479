"""Commands that write files for other tools: convert, onnx."""

import argparse
from pathlib import Path

from polarnet.cli.options import READING, duration_us, given, reading_of
from polarnet.cli.outputs import run_folder
from polarnet.cli.stores import is_store
from polarnet.events.stream import slice_time
from polarnet.networks.onnx_export import TOLERANCE, export_network
from polarnet.networks.registry import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.recordings.arrangements import shifted
from polarnet.recordings.recording import read_recording
from polarnet.runtime.files import replaced
from polarnet.storage.events import EventStore
from polarnet.storage.exchange import FORMS, export_store

SUFFIXES = {".h5": "hdf5", ".hdf5": "hdf5", ".txt": "text", ".raw": "evt3"}


def convert(options: argparse.Namespace) -> None:
    """Convert a recording, or the sequences of an event store."""
    if options.part is None and is_store(options.file):
        _convert_store(options)
    elif options.sequence:
        raise ValueError("--sequence: expected an event store without --part; leave it out")
    else:
        _convert_recording(options, Path(options.file))


def _convert_store(options: argparse.Namespace) -> None:
    if listed := given(options, ["start", "stop", *READING]):
        raise ValueError(f"an event store: expected no {listed} without --part; leave it out")
    store = EventStore.open(options.file)
    with run_folder(options.out, "convert") as folder:
        export_store(store, folder, options.to or "hdf5", options.sequence)
    print(f"{options.file} -> {options.out}")


def _convert_recording(options: argparse.Namespace, file: Path) -> None:
    form = options.to or SUFFIXES.get(options.out.suffix.lower())
    if form is None:
        raise ValueError(f"{options.out}: expected a suffix of {', '.join(SUFFIXES)}, or --to FORMAT")
    if options.out.exists() and options.out.samefile(file):
        raise ValueError(f"{options.out}: expected another file than the one to convert; name another")
    start_us, stop_us = duration_us(options, "start", "500ms") or 0, duration_us(options, "stop", "500ms")
    recording = read_recording(file, part=options.part, **reading_of(options))
    events = recording.events
    origin_us, last_us = (int(events.t[0]), int(events.t[-1])) if len(events) else (0, 0)
    stop_us = last_us - origin_us + 1 if stop_us is None else stop_us
    if stop_us <= start_us:
        raise ValueError(f"expected --stop after --start, got {start_us} to {stop_us} us of {last_us - origin_us} us")
    part = shifted(slice_time(events, origin_us + start_us, origin_us + stop_us), origin_us + start_us)
    with replaced(options.out) as temporary:
        FORMS[form][1](temporary, part, max(0, min(stop_us, last_us - origin_us + 1) - start_us))
    print(
        f"{file} ({recording.format}) -> {options.out} ({form}): {len(part):,} of {len(events):,} events, "
        f"time 0 is {origin_us + start_us} us"
    )
    for kind, count in recording.repairs.items():
        print(f"repaired {kind}: {count}")


def onnx(options: argparse.Namespace) -> None:
    """Export a network as an ONNX file."""
    weights = options.weights or shipped_weights()
    export_network(*load_network(weights), options.file, options.height, options.width)
    size = options.file.stat().st_size / 1e6
    print(f"{weights} -> {options.file}, {size:.1f} MB; ONNX Runtime's outputs equal torch's within {TOLERANCE:g}")
