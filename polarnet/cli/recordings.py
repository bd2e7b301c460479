"""Commands for recordings: inspect, recover DoLP."""

import argparse
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from polarnet.cli.outputs import WORK, run_folder
from polarnet.cli.parsers import (
    READING_OPTIONS,
    Commands,
    add_cleaning,
    add_hot_pixel_factor,
    add_reading,
    cleaning_of,
    duration_us,
    reading_of,
)
from polarnet.cli.project import settings_root

if TYPE_CHECKING:
    from polarnet.captures.dot import RecordingsConfig
    from polarnet.methods.method import Method, Setup
    from polarnet.recordings.live import LiveLines
    from polarnet.recordings.live_camera import LiveCamera
    from polarnet.recordings.noise import Cleaner
    from polarnet.recordings.polarizers import ChannelCheck
    from polarnet.recovery.stream import Input
    from polarnet.stokes import Mosaic
    from polarnet.storage.true_frames import TrueFrames

CLEANING_OPTIONS = ("hot_pixels", "background")
"""Options that remove noise before recovery."""

RECONSTRUCT = "highpass"
"""Method whose intensities are the S0 of the video."""

BESIDE = ""
"""Value of --truth without a path."""

NETWORK_WINDOW = "33.333ms"

OPTIONS_BY_INPUT = {
    "--live": {"mosaic", "rate", *CLEANING_OPTIONS},
    "four files": {"angles", "size", "rate", *CLEANING_OPTIONS, *READING_OPTIONS},
    "one file with --mosaic": {"mosaic", "size", "rate", *CLEANING_OPTIONS, *READING_OPTIONS},
    "one file with --rotating or --triggers": {"rotating", "triggers", "start_angle", "size", *READING_OPTIONS},
    "one file without polarizers": {"size", *CLEANING_OPTIONS, *READING_OPTIONS},
    "an event store or a folder": {"sequence", "truth", "size", "rate", *CLEANING_OPTIONS},
}
"""Options of `polarnet recover` that apply to each kind of input."""


RECOVER_DESCRIPTION = """\
Writes frames, pictures, a video and a page. INPUT is one of:
  four files, one for each polarizer, with --angles
  one file of a camera with polarizers on its pixels, with --mosaic
  one file of a camera behind a rotating polarizer, with --rotating or --triggers
  an event store, or a folder that `polarnet convert` or `polarnet simulate --format hdf5` wrote
  a folder of division-of-time captures
  with --live, a growing file or standard input (-) with lines `t x y p angle`, or a camera with --mosaic:
  dv://HOST:PORT of a program that streams its events, or dv://camera
With a --method that reconstructs intensity, any other file of a camera gives plain intensity."""

RECOVER_EXAMPLES = """\
examples:
  polarnet recover recording.aedat4 --mosaic "90 45 / 135 0"
  polarnet recover 0.raw 45.raw 90.raw 135.raw --angles 0 45 90 135 --hot-pixels found
  polarnet recover outputs/simulate/lake/events.zarr --truth
  polarnet recover data/events.zarr --sequence lake-0 --rate 2000 --write mp4
  polarnet recover camera.raw --rotating 15
  polarnet recover dv://camera --live --mosaic "90 45 / 135 0\""""


def add_to(commands: Commands) -> None:
    """Add the commands inspect and recover."""
    _add_inspection(commands)
    _add_recovery(commands)


def _add_inspection(commands: Commands) -> None:
    inspect = commands.add_parser(
        "inspect",
        help="summarise a camera's file and draw its busiest moment, or list the sequences of a store",
        description="Prints format, sensor size (height x width), duration, event counts, rates and hot pixels of a "
        "camera's file, with signs of a readout at its limit, and draws its busiest moment as a PNG. Of a store it "
        "names the sequences.",
        epilog="example: polarnet inspect recording.aedat4 --hot-pixels hot.png",
    )
    inspect.add_argument("file", help="file of a camera, an event store with --part, or a store to list")
    add_reading(inspect)
    inspect.add_argument("--part", metavar="SEQUENCE/ANGLE", help="sequence and channel of an event store: NAME/45")
    add_hot_pixel_factor(inspect)
    inspect.add_argument("--out", type=Path, metavar="FOLDER", help="folder of the PNG (default: outputs/inspect)")
    inspect.add_argument("--picture", type=Path, help="PNG of the busiest moment (default: OUT/FILE.png)")
    inspect.add_argument(
        "--hot-pixels", type=Path, metavar="PNG", help="PNG of the number of events of each pixel (default: not drawn)"
    )
    inspect.set_defaults(run=_inspect)


def _add_recovery(commands: Commands) -> None:
    recover = commands.add_parser(
        "recover",
        help="recover DoLP and AoLP from recordings or from a running camera",
        description=RECOVER_DESCRIPTION,
        epilog=RECOVER_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_input(recover)
    add_cleaning(recover)
    _add_method(recover)
    _add_output(recover)
    add_reading(recover)
    recover.set_defaults(run=_recover)


def _add_input(recover: argparse.ArgumentParser) -> None:
    """Add the input, and the options that describe its polarizers, its sequences and its size."""
    recover.add_argument("input", nargs="+", metavar="INPUT", help="recordings, an event store, a folder, or -")
    recover.add_argument(
        "--angles", nargs=4, type=int, metavar="DEG", help="polarizer angles of the four files, in order"
    )
    recover.add_argument(
        "--mosaic", metavar="'A B / C D'", help="polarizer angles of 2x2 pixels in degrees: even row / odd row"
    )
    recover.add_argument(
        "--rotating", type=float, metavar="HZ", help="turns per second of a polarizer before the one camera"
    )
    recover.add_argument(
        "--triggers",
        type=Path,
        metavar="FILE",
        help="times of that polarizer's triggers in us, one a turn: text or HDF5",
    )
    recover.add_argument(
        "--start-angle", type=float, metavar="DEG", help="polarizer angle at time 0 or the first trigger (default: 0)"
    )
    recover.add_argument("--sequence", metavar="NAME", help="sequence of an event store or folder with several")
    recover.add_argument(
        "--truth", nargs="?", const=BESIDE, metavar="FRAMES",
        help="score the frames against the true frames of an event store: frames.zarr or truth.zarr (default: those "
        "beside the store)",
    )  # fmt: skip
    recover.add_argument("--live", action="store_true", help="recover while events arrive, and print the latency")
    recover.add_argument(
        "--idle",
        type=float,
        default=5.0,
        metavar="S",
        help="seconds without growth after which a live file has ended (default: 5)",
    )
    recover.add_argument(
        "--size", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), help="reduce the sensor to this many rows and columns"
    )


def _add_method(recover: argparse.ArgumentParser) -> None:
    """Add the window and the method that recovers DoLP from it."""
    recover.add_argument(
        "--window",
        help="length of a window: a time (33.3ms) or a number of events of all channels (20000ev); networks are "
        "trained on windows of 1/30 s (default: 33.333ms; with --rotating: modulation.window_turns)",
    )  # fmt: skip
    recover.add_argument(
        "--step",
        help="time between the ends of overlapping windows, at least 0.1ms (default: no overlap; with "
        "--rotating: half a turn)",
    )
    recover.add_argument(
        "--rate",
        type=float,
        metavar="HZ",
        help="frames a second, such as 2000: events carry each frame on to the next window (default: a frame a window)",
    )
    recover.add_argument(
        "--weights", type=Path, metavar="FILE",
        help="checkpoint of the network (default: the shipped one), or file of the --method's network"
    )  # fmt: skip
    recover.add_argument(
        "--thresholds",
        nargs=2,
        type=float,
        metavar=("ON", "OFF"),
        help="contrast thresholds of the camera, natural-log intensity (default: estimated from the events); "
        "`polarnet fit-sensor` measures them",
    )
    recover.add_argument(
        "--binning", type=int, metavar="N",
        help="show the network blocks of N x N pixels, averaged: with 2, it is faster and sees less detail "
        "(default: as in its training)",
    )  # fmt: skip
    recover.add_argument(
        "--method", help="method of the benchmark instead of the network: cf, highpass, cf+gain, e2v, ..."
    )
    recover.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N (default: auto)")
    recover.add_argument(
        "--precision",
        choices=("auto", "fp32", "bf16"),
        default="auto",
        help="number format of the network; auto takes bf16 if the device has units for it (default: auto)",
    )


def _add_output(recover: argparse.ArgumentParser) -> None:
    recover.add_argument("--out", type=Path, metavar="FOLDER", help="output folder (default: outputs/recover/NAME)")
    recover.add_argument(
        "--write", nargs="+", choices=("zarr", "png", "exr", "mp4"), default=("zarr", "png", "mp4"),
        help="file types to write (default: zarr png mp4)",
    )  # fmt: skip
    recover.add_argument(
        "--video-rate", type=float, default=30.0, metavar="HZ", help="frames a second of the video (default: 30)"
    )


def _inspect(options: argparse.Namespace) -> int:
    from polarnet.cli.verification import is_store, listing
    from polarnet.recordings.inspection import findings, inspect_recording
    from polarnet.recordings.recording import open_recording
    from polarnet.reports.recordings import recording_picture

    if options.part is None and is_store(options.file):
        print(*listing(options.file), sep="\n")
        return 0
    file = Path(options.file)
    recording = open_recording(file, part=options.part, **reading_of(options))
    inspection = inspect_recording(recording, options.hot_pixel_factor)
    for finding in findings(inspection):
        print(finding)
    folder = options.out or Path("outputs") / "inspect"
    path = options.picture or folder / f"{file.name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(recording_picture(inspection))
    print(f"picture     {path}")
    if options.hot_pixels:
        from polarnet.reports.recordings import draw_hot_pixels

        draw_hot_pixels(inspection.counts, inspection.hot, options.hot_pixels)
        print(f"hot pixels  {options.hot_pixels}")
    return 0


def _recover(options: argparse.Namespace) -> int:
    from polarnet.config.pipeline import setup_of
    from polarnet.config.tree import load
    from polarnet.events.streaming import WindowRule, parse_window
    from polarnet.methods import METHODS
    from polarnet.recordings.noise import Cleaner
    from polarnet.recordings.polarizers import ChannelCheck
    from polarnet.recovery.rate import Rate, check_rate, frames_at_rate
    from polarnet.recovery.stream import facts_of, frames_of, open_method, recover
    from polarnet.recovery.watching import TruthScores
    from polarnet.recovery.writer import RecoveryWriter
    from polarnet.stokes import POLARIZER_ANGLES_DEG, parse_mosaic

    refuse_unused_options(options)
    cleaning = cleaning_of(options)
    if options.rotating is not None or options.triggers is not None:
        return _recover_rotating(options)
    config = functools.cache(lambda: load(settings_root()))

    def setup(method: "Method") -> "Setup":
        return setup_of(config(), method)

    rule = WindowRule(*parse_window(options.window or NETWORK_WINDOW), duration_us(options, "step", "0.1ms"))
    recoverer, words = open_method(
        options.method, options.weights, options.device, options.precision, setup, options.thresholds, options.binning
    )
    rate = None
    if options.rate is not None:
        check_rate(options.rate, rule, recoverer)
        rate = Rate(options.rate, config().between.with_thresholds(options.thresholds))
    truth = _truth_of(options)
    scores = TruthScores(truth) if truth else None
    out = options.out or Path("outputs") / "recover" / ("live" if options.live else Path(options.input[0]).stem)
    mosaic = parse_mosaic(options.mosaic) if options.mosaic else None
    cleaner = Cleaner(cleaning, mosaic)
    with run_folder(out, "recover") as folder:
        if options.live:
            print(f"writing frames to {folder}; the folder becomes {out} at the end", file=sys.stderr)
        source, lines = _input(options, mosaic, cleaner, folder / WORK, lambda: config().recordings)
        check, polarized = None, source.channels == len(POLARIZER_ANGLES_DEG)
        if polarized:
            check = ChannelCheck(source.height, source.width, mosaic=mosaic is not None)
            source = source._replace(pieces=check.watch(source.pieces))
        drawn = polarized and "mp4" in options.write and truth is None
        reconstruct = METHODS[RECONSTRUCT].open(setup(METHODS[RECONSTRUCT])) if drawn else None
        writer = RecoveryWriter(folder, options.write, options.video_rate, reconstruct, truth)
        frames = frames_at_rate(source, rule, recoverer, rate) if rate else frames_of(source, rule, recoverer)
        if scores:
            frames = scores.watch(frames)
        facts = facts_of(source, rule, words, recover(source, rule, recoverer, writer, frames))
        facts |= _further_facts(options.rate, check)
        if scores:
            facts["scores"] = scores.sentence(config().benchmark.warmup_windows)
        if any(getattr(options, option) for option in CLEANING_OPTIONS):
            facts["removed"] = cleaner.sentence()
        notes = check.findings() if check else []
        if left_out := {kind: count for kind, count in lines.counts.items() if count} if lines else {}:
            notes.append(f"Unusable lines were left out: {left_out}.")
        page = writer.write_page(source.name, facts, notes)
    _print_run(facts, notes, out / page.name)
    return 0


def _further_facts(rate_hz: float | None, check: "ChannelCheck | None") -> dict[str, str]:
    """Facts about the rate of the frames and the events of each channel, where they apply."""
    from polarnet.stokes import POLARIZER_ANGLES_DEG

    facts = {}
    if rate_hz is not None:
        facts["rate"] = f"{rate_hz:g} frames a second, carried on by the events from window to window"
    if check:
        counts = zip(POLARIZER_ANGLES_DEG, check.counts, strict=True)
        facts["events"] = ", ".join(f"{count:,} at {angle}" for angle, count in counts) + " degrees"
    return facts


def _input(
    options: argparse.Namespace,
    mosaic: "Mosaic | None",
    cleaner: "Cleaner",
    work: Path,
    captures: "Callable[[], RecordingsConfig]",
) -> "tuple[Input, LiveLines | LiveCamera | None]":
    """Cleaned events of the input; for live input also its reader, which counts the unusable lines."""
    from polarnet.recordings.recording import read_recording
    from polarnet.recovery.stream import Arrangement, open_files, open_live

    if options.live:
        source, lines = open_live(options.input[0], mosaic, options.idle)
        return source._replace(pieces=cleaner.live(source.pieces)), lines
    read = functools.partial(read_recording, **reading_of(options))
    arrangement = Arrangement(options.angles, mosaic, options.sequence)
    files, size = [Path(path) for path in options.input], options.size and tuple(options.size)
    return open_files(files, arrangement, read, size, work, captures, _reconstructs(options.method), cleaner), None


def _print_run(facts: Mapping[str, str], notes: Sequence[str], page: Path) -> None:
    for key, value in facts.items():
        print(f"{key:11s} {value}")
    for note in notes:
        print(f"polarnet recover: warning: {note}", file=sys.stderr)
    print(f"page        {page}")


def _truth_of(options: argparse.Namespace) -> "TrueFrames | None":
    """True frames of option --truth; ValueError if the input is not a store with them."""
    from polarnet.recordings.recording import detect_format
    from polarnet.storage.events import EventStore
    from polarnet.storage.true_frames import open_truth, truth_beside

    if options.truth is None:
        return None
    path = options.input[0]
    if options.size or detect_format(Path(path)) != "store":
        raise ValueError("--truth: expected an event store in its own size; leave out --truth or --size")
    truth = truth_beside(path) if options.truth == BESIDE else options.truth
    if truth is None:
        raise ValueError(f"--truth: expected frames.zarr or truth.zarr beside {path}, there is none; name them")
    return open_truth(truth, options.sequence or EventStore.open(path).sequences[0])


def _reconstructs(method: str | None) -> bool:
    """Whether a method reconstructs intensity from one channel; NAME+gain needs four."""
    from polarnet.methods import METHODS

    return method in METHODS and METHODS[method].reconstructs and METHODS[method].wraps is None


def _recover_rotating(options: argparse.Namespace) -> int:
    from polarnet.config.tree import load
    from polarnet.methods.half_turns import half_turns_recoverer
    from polarnet.methods.rotating_polarizer import rotating_recoverer
    from polarnet.recordings.recording import read_recording
    from polarnet.recovery.rotating import half_turn_rule, open_rotating, rotation_of
    from polarnet.recovery.stream import facts_of, recover
    from polarnet.recovery.writer import RecoveryWriter

    if options.method not in (None, "rotating_polarizer") or options.weights or options.thresholds or options.binning:
        raise ValueError(
            "--rotating: expected no --method but rotating_polarizer (for moving scenes), and no --weights, "
            "--thresholds or --binning, because a fit recovers DoLP without a network, with the thresholds of "
            "params.yaml; leave it out"
        )
    settings = load(settings_root())
    config, moving = settings.modulation, options.method is not None
    file, size = Path(options.input[0]), options.size and tuple(options.size)
    rotation = rotation_of(options.rotating, options.triggers, options.start_angle or 0.0)
    length_us, step_us = (duration_us(options, name, "500ms") for name in ("window", "step"))
    rule = half_turn_rule(rotation, 0.5 if moving else config.window_turns, length_us, step_us)
    out = options.out or Path("outputs") / "recover" / file.stem
    with run_folder(out, "recover") as folder:
        source, rotation = open_rotating(file, rotation, functools.partial(read_recording, **reading_of(options)), size)
        writer = RecoveryWriter(folder, options.write, options.video_rate)
        if moving:
            recoverer = half_turns_recoverer(settings.methods.rotating_polarizer, rotation)
        else:
            recoverer = rotating_recoverer(config, rotation)
        fitted = "each half turn of" if moving else "the modulation by"
        words = f"fit to {fitted} a polarizer at {rotation.rate_hz:g} turns/s"
        facts = facts_of(source, rule, words, recover(source, rule, recoverer, writer))
        page = writer.write_page(source.name, facts, [])
    _print_run(facts, [], out / page.name)
    return 0


def refuse_unused_options(options: argparse.Namespace) -> None:
    """ValueError for an option that does not apply to the given kind of input."""
    if options.live and len(options.input) != 1:
        raise ValueError(f"--live: expected one file or -, got {len(options.input)}")
    if options.live:
        kind = "--live"
    elif len(options.input) > 1:
        kind = "four files"
    elif options.rotating is not None or options.triggers is not None:
        kind = "one file with --rotating or --triggers"
    elif options.mosaic is not None:
        kind = "one file with --mosaic"
    elif Path(options.input[0]).is_dir():
        kind = "an event store or a folder"
    elif _reconstructs(options.method):
        kind = "one file without polarizers"
    else:
        return  # reading the input will name the missing option
    unused = set().union(*OPTIONS_BY_INPUT.values()) - OPTIONS_BY_INPUT[kind]
    given = [f"--{name.replace('_', '-')}" for name in sorted(unused) if getattr(options, name) is not None]
    if given:
        raise ValueError(f"{kind}: expected no {', '.join(given)}, which does not apply to this input; leave it out")
