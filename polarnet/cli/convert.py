"""Commands that write files for other tools: convert, onnx."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from polarnet.cli.options import READING, duration_us, opener_of, refuse
from polarnet.cli.outputs import run_folder
from polarnet.cli.stores import is_store
from polarnet.events.stream import Events, shifted, slice_time
from polarnet.networks.onnx_export import TOLERANCE, export_network
from polarnet.networks.registry import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.recordings.recording import RecordingReader
from polarnet.recordings.repair import MAX_TIME
from polarnet.recordings.source import RecordingError
from polarnet.recordings.writers import FORMS, export_store
from polarnet.runtime.files import replaced
from polarnet.storage.events import EventStore

SUFFIXES = {".h5": "hdf5", ".hdf5": "hdf5", ".txt": "text", ".raw": "evt3"}


def convert(options: argparse.Namespace) -> None:
    """Convert a recording, or the sequences of an event store."""
    if is_store(options.file):
        _convert_store(options)
    else:
        _convert_recording(options, Path(options.file))


def _convert_store(options: argparse.Namespace) -> None:
    refuse(options, "an event store", ["start", "stop", *READING])
    store = EventStore.open(options.file)
    with run_folder(options.out, "convert") as folder:
        export_store(store, folder, options.to or "hdf5", options.sequence)
    print(f"{options.file} -> {options.out}")


def _convert_recording(options: argparse.Namespace, file: Path) -> None:
    refuse(options, "a recording", ["sequence"])
    form = options.to or SUFFIXES.get(options.out.suffix.lower())
    if form is None:
        raise ValueError(f"{options.out}: expected a suffix of {', '.join(SUFFIXES)}, or --to FORMAT")
    if options.out.exists() and options.out.samefile(file):
        raise ValueError(f"{options.out}: expected another file than the one to convert; name another")
    start_us, stop_us = duration_us(options, "start", "500ms") or 0, duration_us(options, "stop", "500ms")
    if stop_us is not None and stop_us <= start_us:
        raise ValueError(f"expected --stop after --start, got {start_us} to {stop_us} us")
    reader = opener_of(options)(file)
    span = _Span(start_us, stop_us)
    with replaced(options.out) as temporary:
        FORMS[form][1](temporary, span.chunks(reader))
        if start_us and not span.count:
            raise ValueError(f"{file.name}: expected events between --start and --stop, there are none; leave them out")
    print(f"{file} ({reader.format}) -> {options.out} ({form}): {span.count:,} events, time 0 is {span.origin_us} us")
    for kind, count in reader.repairs.items():
        if count:
            print(f"repaired {kind}: {count}")


class _Span:
    """A span of time after a recording's first event, read no further than its end."""

    def __init__(self, start_us: int, stop_us: int | None):
        self.count = self.origin_us = 0
        self._start_us, self._stop_us = start_us, stop_us

    def chunks(self, reader: RecordingReader) -> Iterator[Events]:
        """Its events, in chunks, the first of which may be empty; times count from its start.

        A clock that was set anew before the span's start is no error, see `RecordingReader.chunks`.
        """
        yield Events.empty(reader.height, reader.width)
        first_us = last_us = stop_us = None
        try:
            for chunk in reader.chunks(bridged_us=self._start_us):
                first_us, last_us = int(chunk.t[0]) if first_us is None else first_us, int(chunk.t[-1])
                self.origin_us = first_us + self._start_us
                stop_us = MAX_TIME if self._stop_us is None else first_us + self._stop_us
                part = shifted(slice_time(chunk, self.origin_us, stop_us), self.origin_us)
                self.count += len(part)
                yield part
                if last_us >= stop_us:
                    return
        except RecordingError:
            if last_us is None or last_us + 1 != stop_us:  # else the span ends where the damage begins
                raise


def onnx(options: argparse.Namespace) -> None:
    """Export a network as an ONNX file."""
    weights = options.weights or shipped_weights()
    export_network(*load_network(weights), options.file, options.height, options.width)
    size = options.file.stat().st_size / 1e6
    print(f"{weights} -> {options.file}, {size:.1f} MB; ONNX Runtime's outputs equal torch's within {TOLERANCE:g}")
