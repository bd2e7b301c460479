"""Command that converts a recording to another format."""

import argparse
from pathlib import Path

from polarnet.cli.parsers import Commands, add_reading, duration_us, reading_of

SUFFIXES = {".h5": "hdf5", ".hdf5": "hdf5", ".txt": "text", ".raw": "evt3"}


def add_to(commands: Commands) -> None:
    """Add the command convert."""
    convert = commands.add_parser(
        "convert",
        help="convert a recording to HDF5 (DSEC's layout), text or EVT3",
        description="Reads any recording that `polarnet inspect` reads, repairs it as reading does, and writes its "
        "events, or those of a time span. Times in OUT count from the start of the span.",
        epilog="example: polarnet convert recording.aedat4 first.h5 --start 500ms --stop 2s",
    )
    convert.add_argument("file", type=Path, metavar="IN", help="file of a camera, a bag, or an event store with --part")
    convert.add_argument("out", type=Path, metavar="OUT", help="file to write")
    convert.add_argument("--to", choices=sorted(set(SUFFIXES.values())), help="format of OUT (default: by its suffix)")
    convert.add_argument("--start", metavar="TIME", help="start of the span after the first event: 500ms (default: 0s)")
    convert.add_argument("--stop", metavar="TIME", help="end of the span after the first event, exclusive")
    convert.add_argument("--part", metavar="PART", help="SEQUENCE/ANGLE of an event store, or topic of a bag")
    add_reading(convert)
    convert.set_defaults(run=_convert)


def _convert(options: argparse.Namespace) -> int:
    from polarnet.events.stream import slice_time
    from polarnet.recordings.arrangements import shifted
    from polarnet.recordings.recording import read_recording
    from polarnet.runtime.files import replaced
    from polarnet.storage.exchange import FORMS

    form = options.to or SUFFIXES.get(options.out.suffix.lower())
    if form is None:
        raise ValueError(f"{options.out}: expected a suffix of {', '.join(SUFFIXES)}, or --to FORMAT")
    if options.out.exists() and options.out.samefile(options.file):
        raise ValueError(f"{options.out}: expected another file than the one to convert; name another")
    start_us, stop_us = duration_us(options, "start", "500ms") or 0, duration_us(options, "stop", "500ms")
    recording = read_recording(options.file, part=options.part, **reading_of(options))
    events = recording.events
    origin_us = int(events.t[0]) if len(events) else 0
    last_us = int(events.t[-1]) if len(events) else 0
    stop_us = last_us - origin_us + 1 if stop_us is None else stop_us
    if stop_us <= start_us:
        raise ValueError(f"expected --stop after --start, got {start_us} to {stop_us} us of {last_us - origin_us} us")
    part = shifted(slice_time(events, origin_us + start_us, origin_us + stop_us), origin_us + start_us)
    with replaced(options.out) as temporary:
        FORMS[form][1](temporary, part, max(0, min(stop_us, last_us - origin_us + 1) - start_us))
    print(
        f"{options.file} ({recording.format}) -> {options.out} ({form}): {len(part):,} of {len(events):,} events, "
        f"time 0 is {origin_us + start_us} us"
    )
    for kind, count in recording.repairs.items():
        print(f"repaired {kind}: {count}")
    return 0
