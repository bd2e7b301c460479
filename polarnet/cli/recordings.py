"""Commands on recordings: look into them, lay them on one another, recover DoLP, play them."""

import argparse
import functools
import json
import sys
from pathlib import Path
from typing import Any

from polarnet.cli.outputs import WORK, run_folder
from polarnet.cli.parsers import Commands
from polarnet.cli.project import settings_root

OF_FILES = ("format", "height", "width", "clock_mhz", "assume_polarity")
"""Options of commands that say how to read a camera's files."""

TAKEN = {
    "--live": {"mosaic"},
    "four files": {"angles", "size", *OF_FILES},
    "one file with --mosaic": {"mosaic", "size", *OF_FILES},
    "an event store or a folder": {"sequence", "size"},
}
"""Which options about its input `polarnet recover` takes."""


def add_to(commands: Commands) -> None:
    """Its commands."""
    _add_inspection(commands)
    _add_recovery(commands)


def _add_inspection(commands: Commands) -> None:
    inspect = commands.add_parser("inspect", help="what is in a camera's file, and a picture of its busiest moment")
    inspect.add_argument("file", type=Path)
    _add_reading(inspect)
    inspect.add_argument("--part", metavar="SEQUENCE/ANGLE", help="of an event store")
    inspect.add_argument(
        "--hot-pixel-factor", type=float, default=4.0, help="hot: as many times the third busiest around (4)"
    )
    inspect.add_argument("--picture", type=Path, help="where to write the PNG (default: FILE.png here)")
    inspect.add_argument("--hot-pixels", type=Path, metavar="PNG", help="where to draw how often each pixel fired")
    inspect.set_defaults(run=_inspect)

    register = commands.add_parser("register", help="lay one camera's recording on another's: the homography")
    register.add_argument("reference", type=Path)
    register.add_argument("file", type=Path)
    _add_reading(register)
    register.add_argument("--picture", type=Path, help="where to write a PNG of both event images, before and after")
    register.set_defaults(run=_register)


def _add_reading(command: argparse.ArgumentParser) -> None:
    """The options of `OF_FILES`."""
    command.add_argument("--format", help="where the content does not show it: text, celex5_csv, celex5_bin, dat, ...")
    command.add_argument("--height", type=int, help="of the sensor, where the file does not say it")
    command.add_argument("--width", type=int)
    command.add_argument("--clock-mhz", type=float, help="of a CeleX-5, where it was not 100 MHz")
    command.add_argument("--assume-polarity", type=int, choices=(1, -1), help="of events that come without one")


def _reading(options: argparse.Namespace) -> dict[str, Any]:
    return {name: getattr(options, name) for name in OF_FILES}


def _add_recovery(commands: Commands) -> None:
    recover = commands.add_parser(
        "recover",
        help="DoLP and AoLP of recordings, or of a camera that runs: frames, pictures, a video and a page",
        description="INPUT is four files, one a polarizer, with --angles; one file of a camera with polarizers on its "
        "pixels, with --mosaic; an event store; a folder of division-of-time captures; or, with --live, lines "
        "`t x y p angle` of a file that grows or of standard input (-).",
    )
    recover.add_argument("input", nargs="+", metavar="INPUT")
    recover.add_argument("--angles", nargs=4, type=int, metavar="DEG", help="polarizers of the four files, in order")
    recover.add_argument(
        "--mosaic", metavar="'A B / C D'", help="polarizers of 2x2 pixels: even row / odd row, degrees"
    )
    recover.add_argument("--sequence", metavar="NAME", help="of an event store with several")
    recover.add_argument("--live", action="store_true", help="recover while events come, and show the latency")
    recover.add_argument(
        "--idle", type=float, default=5.0, metavar="S", help="a live file that stops growing has ended"
    )
    recover.add_argument(
        "--size", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), help="reduce files to so many pixels"
    )
    recover.add_argument(
        "--window", default="33.333ms",
        help="a time (33.3ms) or a number of events of all polarizers (20000ev); networks are trained on 1/30 s",
    )  # fmt: skip
    recover.add_argument("--step", help="time between the ends of overlapping windows, from 0.1ms; default: no overlap")
    recover.add_argument(
        "--weights", type=Path, metavar="FILE", help="of the network; default: shipped, or trained here"
    )
    recover.add_argument("--method", help="instead of the network: cf, highpass, cf+gain, e2v, ... of the benchmark")
    recover.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N")
    recover.add_argument(
        "--precision",
        choices=("auto", "fp32", "bf16"),
        default="auto",
        help="auto: bf16 where the device has units for it",
    )
    recover.add_argument("--out", type=Path, metavar="FOLDER", help="default: outputs/recover/NAME")
    recover.add_argument("--write", nargs="+", choices=("zarr", "png", "exr", "mp4"), help="default: zarr png mp4")
    recover.add_argument("--video-rate", type=float, default=30.0, metavar="HZ", help="frames a second of the video")
    _add_reading(recover)
    recover.set_defaults(run=_recover)

    replay = commands.add_parser(
        "replay", help="a stored sequence as live lines, at its own pace: polarnet recover --live"
    )
    replay.add_argument("store", help="folder, zip or fsspec URL")
    replay.add_argument("sequence")
    replay.add_argument("--speed", type=float, default=1.0, help="times as fast as recorded")
    replay.set_defaults(run=_replay)


def _inspect(options: argparse.Namespace) -> int:
    from polarnet.recordings.inspection import findings, inspect_recording
    from polarnet.recordings.recording import open_recording
    from polarnet.reports.recordings import recording_picture

    recording = open_recording(options.file, part=options.part, **_reading(options))
    inspection = inspect_recording(recording, options.hot_pixel_factor)
    for finding in findings(inspection):
        print(finding)
    path = options.picture or Path(f"{options.file.name}.png")
    path.write_bytes(recording_picture(inspection))
    print(f"picture     {path}")
    if options.hot_pixels:
        from polarnet.reports.calibration import draw_hot_pixels

        draw_hot_pixels(inspection.counts, inspection.hot, options.hot_pixels)
        print(f"hot pixels  {options.hot_pixels}")
    return 0


def _register(options: argparse.Namespace) -> int:
    from polarnet.recordings.recording import read_recording
    from polarnet.recordings.registration import UNRELATED, event_image, register, warped
    from polarnet.reports.calibration import draw_registration

    files = options.reference, options.file
    reference, moving = (event_image(read_recording(path, **_reading(options)).events) for path in files)
    found = register(reference, moving)
    print(json.dumps({**found._asdict(), "homography": found.homography.tolist()}, indent=2))
    if found.edge_correlation < UNRELATED:
        print(
            f"polarnet register: warning: the edges of the two recordings do not meet (correlation "
            f"{found.edge_correlation:.2f}, expected at least {UNRELATED:g}): do not use this homography. They show "
            f"other scenes, too few edges, or cameras too far apart",
            file=sys.stderr,
        )
    if options.picture:
        draw_registration(reference, moving, warped(moving, found.homography), options.picture)
    return 0


def _recover(options: argparse.Namespace) -> int:
    from polarnet.config.pipeline import setup_of
    from polarnet.config.tree import load
    from polarnet.events.streaming import WindowRule, parse_window
    from polarnet.recordings.polarizers import ChannelCheck
    from polarnet.recordings.recording import read_recording
    from polarnet.recovery.recover import Arrangement, facts_of, open_files, open_live, open_method, recover
    from polarnet.recovery.writer import RecoveryWriter
    from polarnet.stokes import POLARIZER_ANGLES_DEG, parse_mosaic

    _check_taken(options)
    config = functools.cache(lambda: load(settings_root()))
    length_us, events = parse_window(options.window)
    step_us, step_events = parse_window(options.step) if options.step else (None, None)
    if step_events is not None:
        raise ValueError(f"--step: expected a time such as 0.1ms, got {options.step}")
    rule = WindowRule(length_us, events, step_us)
    recoverer, words = open_method(
        options.method, options.weights, options.device, options.precision, lambda method: setup_of(config(), method)
    )
    name = "live" if options.live else Path(options.input[0]).stem
    out = options.out or Path("outputs") / "recover" / name
    mosaic = parse_mosaic(options.mosaic) if options.mosaic else None
    lines = None
    with run_folder(out, "recover") as folder:
        if options.live:
            print(f"frames come into {folder}, and move to {out} at the end", file=sys.stderr)
            source, lines = open_live(options.input[0], mosaic, options.idle)
        else:
            read = functools.partial(read_recording, **_reading(options))
            arrangement = Arrangement(options.angles, mosaic, options.sequence)
            size = (options.size[0], options.size[1]) if options.size else None
            files, captures = [Path(path) for path in options.input], lambda: config().recordings
            source = open_files(files, arrangement, read, size, folder / WORK, captures)
        check = ChannelCheck(source.height, source.width, mosaic=mosaic is not None)
        source = source._replace(pieces=check.watch(source.pieces))
        writer = RecoveryWriter(folder, options.write or ("zarr", "png", "mp4"), options.video_rate)
        summary = recover(source, rule, recoverer, writer)
        left_out = {kind: count for kind, count in lines.counts.items() if count} if lines else {}
        notes = [*check.findings(), *([f"Lines that were left out: {left_out}."] if left_out else [])]
        counts = zip(POLARIZER_ANGLES_DEG, check.counts, strict=True)
        facts = facts_of(source, rule, words, summary)
        facts["events"] = ", ".join(f"{count:,} at {angle}" for angle, count in counts) + " degrees"
        page = writer.write_page(source.name, facts, notes)
    for key, value in facts.items():
        print(f"{key:11s} {value}")
    for note in notes:
        print(f"polarnet recover: warning: {note}", file=sys.stderr)
    print(f"the page: {out / page.name}")
    return 0


def _check_taken(options: argparse.Namespace) -> None:
    """ValueError where an option about the input was given that such an input does not take."""
    if options.live and len(options.input) != 1:
        raise ValueError(f"--live: expected one file or -, got {len(options.input)}")
    if options.live:
        kind = "--live"
    elif len(options.input) > 1:
        kind = "four files"
    elif options.mosaic is not None:
        kind = "one file with --mosaic"
    elif Path(options.input[0]).is_dir() or Path(options.input[0]).suffix == ".zip":
        kind = "an event store or a folder"
    else:
        return  # refused for what is missing
    given = [name for name in sorted(set().union(*TAKEN.values()) - TAKEN[kind]) if getattr(options, name) is not None]
    if given:
        named = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise ValueError(f"{kind}: expected no {named}, which would not be used; leave it out")


def _replay(options: argparse.Namespace) -> int:
    from polarnet.recovery.recover import replay
    from polarnet.storage.events import EventStore

    def write(data: bytes) -> None:
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()

    replay(EventStore.open(options.store), options.sequence, options.speed, write)
    return 0
