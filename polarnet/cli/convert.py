"""Command that converts a recording, or the sequences of an event store, to another format."""

import argparse
from pathlib import Path

from polarnet.cli.outputs import run_folder
from polarnet.cli.parsers import Commands, add_reading, duration_us, reading_of

SUFFIXES = {".h5": "hdf5", ".hdf5": "hdf5", ".txt": "text", ".raw": "evt3"}
OF_A_RECORDING = ("start", "stop", "format", "height", "width", "clock_mhz")
"""Options that do not apply to an event store without --part."""

EXAMPLES = """\
examples:
  polarnet convert recording.aedat4 first.h5 --start 500ms --stop 2s
  polarnet convert data/events.zarr exported --to evt3 --sequence lake-0"""


def add_to(commands: Commands) -> None:
    """Add the command convert."""
    convert = commands.add_parser(
        "convert",
        help="convert a recording or an event store to HDF5 (DSEC's layout), text or EVT3",
        description="Reads any recording that `polarnet inspect` reads, repairs it as reading does, and writes its "
        "events, or those of a time span. Times in OUT count from the start of the span. Of an event store without "
        "--part, writes a folder with one file for each sequence and channel.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    convert.add_argument("file", metavar="IN", help="file of a camera, a bag, or an event store (folder or fsspec URL)")
    convert.add_argument("out", type=Path, metavar="OUT", help="file to write; of an event store, the folder")
    convert.add_argument(
        "--to", choices=sorted(set(SUFFIXES.values())), help="format (default: by the suffix of OUT; of a store: hdf5)"
    )
    convert.add_argument("--start", metavar="TIME", help="start of the span after the first event: 500ms (default: 0s)")
    convert.add_argument("--stop", metavar="TIME", help="end of the span after the first event, exclusive")
    convert.add_argument("--part", metavar="PART", help="SEQUENCE/ANGLE of an event store, or topic of a bag")
    convert.add_argument("--sequence", nargs="+", metavar="NAME", help="sequences of an event store (default: all)")
    add_reading(convert)
    convert.set_defaults(run=_convert)


def _convert(options: argparse.Namespace) -> int:
    from polarnet.cli.verification import is_store

    if options.part is None and is_store(options.file):
        return _convert_store(options)
    if options.sequence:
        raise ValueError("--sequence: expected an event store without --part; leave it out")
    return _convert_recording(options, Path(options.file))


def _convert_store(options: argparse.Namespace) -> int:
    from polarnet.storage.events import EventStore
    from polarnet.storage.exchange import export_store

    if given := [f"--{name.replace('_', '-')}" for name in OF_A_RECORDING if getattr(options, name) is not None]:
        raise ValueError(f"an event store: expected no {', '.join(given)} without --part; leave it out")
    store = EventStore.open(options.file)
    with run_folder(options.out, "convert") as folder:
        export_store(store, folder, options.to or "hdf5", options.sequence)
    print(f"{options.file} -> {options.out}")
    return 0


def _convert_recording(options: argparse.Namespace, file: Path) -> int:
    from polarnet.events.stream import slice_time
    from polarnet.recordings.arrangements import shifted
    from polarnet.recordings.recording import read_recording
    from polarnet.runtime.files import replaced
    from polarnet.storage.exchange import FORMS

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
    return 0
