"""Commands for recordings: inspect, recover DoLP."""

import argparse
import functools
import sys
from collections.abc import Sequence
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
    from polarnet.config.tree import Config
    from polarnet.events.rotation import Rotation
    from polarnet.events.streaming import WindowRule
    from polarnet.recordings.noise import ChannelCheck, Cleaner
    from polarnet.recovery.stream import Input
    from polarnet.stokes import Mosaic
    from polarnet.storage.true_frames import TrueFrames

CLEANING_OPTIONS = ("hot_pixels", "background")
"""Options that remove noise before recovery."""

DEFAULT_METHOD, ROTATING_METHOD = "ours", "rotating_polarizer"
RECONSTRUCT = "highpass"
"""Method whose intensities are the S0 of the video."""

BESIDE = ""
"""Value of --truth without a path."""

NETWORK_WINDOW = "33.333ms"

ARRANGEMENTS = ("angles", "mosaic", "rotating", "triggers", "sequence")
"""Options that say where the polarizers are."""
NOT_LIVE = ("angles", "rotating", "triggers", "sequence", "truth", "size", *READING_OPTIONS)
NOT_ROTATING = (
    "angles", "mosaic", "sequence", "truth", "rate", "method", "weights", "thresholds", "binning", "window",
    *CLEANING_OPTIONS,
)  # fmt: skip
"""Options without a meaning for live input, and for one camera behind a rotating polarizer."""

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
        "camera's file, with its longest gap and empty rows, and draws its busiest moment as a PNG. Of a store it "
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
        "trained on windows of 1/30 s (default: 33.333ms)",
    )  # fmt: skip
    recover.add_argument(
        "--step",
        help="time between the ends of overlapping windows, at least 0.1ms (default: no overlap); with --rotating, "
        "time between frames (default: half a turn)",
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
        "--write", nargs="+", choices=("zarr", "png", "mp4"), default=("zarr", "png", "mp4"),
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
    from polarnet.methods import METHODS
    from polarnet.recordings.noise import ChannelCheck, Cleaner
    from polarnet.recovery.rate import Rate, check_rate, frames_at_rate
    from polarnet.recovery.stream import ChosenMethod, TruthScores, frames_of, open_method, recover
    from polarnet.recovery.writer import RecoveryWriter
    from polarnet.stokes import POLARIZER_ANGLES_DEG, parse_mosaic

    check_options(options)
    config = load(settings_root(), [f"runtime.device={options.device}"])
    setup = functools.partial(setup_of, config)
    source, rotation, rule = _rotating(options)
    chosen = ChosenMethod(
        options.method or (ROTATING_METHOD if rotation else DEFAULT_METHOD),
        options.weights,
        options.precision,
        options.thresholds,
        options.binning,
        rotation,
    )
    recoverer, words = open_method(chosen, setup)
    rate = None
    if options.rate is not None:
        check_rate(options.rate, rule, recoverer)
        rate = Rate(options.rate, config.between.with_thresholds(options.thresholds))
    truth = _truth_of(options)
    scores = TruthScores(truth) if truth else None
    out = options.out or Path("outputs") / "recover" / ("live" if options.live else Path(options.input[0]).stem)
    mosaic = parse_mosaic(options.mosaic) if options.mosaic else None
    cleaner = Cleaner(cleaning_of(options), mosaic)
    with run_folder(out, "recover") as folder:
        if options.live:
            print(f"writing frames to {folder}; the folder becomes {out} at the end", file=sys.stderr)
        source = source or _input(options, mosaic, cleaner, folder / WORK, config)
        check, polarized = None, source.channels == len(POLARIZER_ANGLES_DEG)
        if polarized:
            check = ChannelCheck(source.height, source.width)
            source = source._replace(pieces=check.watch(source.pieces))
        drawn = polarized and "mp4" in options.write and truth is None
        reconstruct = METHODS[RECONSTRUCT].open(setup(METHODS[RECONSTRUCT])) if drawn else None
        writer = RecoveryWriter(folder, options.write, options.video_rate, reconstruct, truth)
        frames = frames_at_rate(source, rule, recoverer, rate) if rate else frames_of(source, rule, recoverer)
        if scores:
            frames = scores.watch(frames)
        facts = recover(source, rule, words, writer, frames)
        facts |= _further_facts(options.rate, check)
        if scores:
            facts["scores"] = scores.sentence(config.benchmark.warmup_windows)
        if any(getattr(options, option) for option in CLEANING_OPTIONS):
            facts["removed"] = cleaner.sentence()
        notes = check.findings() if check else []
        if left_out := {kind: count for kind, count in (source.left_out or {}).items() if count}:
            notes.append(f"Unusable lines were left out: {left_out}.")
        page = writer.write_page(source.name, facts, notes)
    for key, value in facts.items():
        print(f"{key:11s} {value}")
    for note in notes:
        print(f"polarnet recover: warning: {note}", file=sys.stderr)
    print(f"page        {out / page.name}")
    return 0


def _rotating(options: argparse.Namespace) -> "tuple[Input | None, Rotation | None, WindowRule]":
    """Input and rotation of one camera behind a rotating polarizer, None for any other input; and the windows."""
    from polarnet.events.streaming import WindowRule, parse_window
    from polarnet.recordings.recording import read_recording
    from polarnet.recovery.inputs import half_turn_rule, open_rotating, rotation_of

    step_us = duration_us(options, "step", "0.1ms")
    if options.rotating is None and options.triggers is None:
        return None, None, WindowRule(*parse_window(options.window or NETWORK_WINDOW), step_us)
    rotation = rotation_of(options.rotating, options.triggers, options.start_angle or 0.0)
    read = functools.partial(read_recording, **reading_of(options))
    source, rotation = open_rotating(Path(options.input[0]), rotation, read, options.size)
    return source, rotation, half_turn_rule(rotation, step_us)


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
    options: argparse.Namespace, mosaic: "Mosaic | None", cleaner: "Cleaner", work: Path, config: "Config"
) -> "Input":
    """Cleaned events of live input, or of files with the arrangement that the options state."""
    from polarnet.recordings.recording import read_recording
    from polarnet.recovery.inputs import Files, open_files, open_live

    if options.live:
        source = open_live(options.input[0], mosaic, options.idle)
        return source._replace(pieces=cleaner.live(source.pieces))
    files = Files(
        [Path(path) for path in options.input],
        options.angles,
        mosaic,
        options.sequence,
        _reconstructs(options.method),
        functools.partial(read_recording, **reading_of(options)),
        config.recordings,
    )
    return open_files(files, work, options.size, cleaner)


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


def check_options(options: argparse.Namespace) -> None:
    """ValueError for options that do not belong together, or that the input would not use."""
    stated = [name for name in ARRANGEMENTS if getattr(options, name) is not None]
    if len(stated) > 1 and stated != ["rotating", "triggers"]:
        raise ValueError(f"expected one arrangement of polarizers, got {_listed(stated)}")
    rotating = "rotating" in stated or "triggers" in stated
    if options.live:
        _refuse(options, "--live", NOT_LIVE)
    if rotating:
        _refuse(options, "--rotating", NOT_ROTATING)
    if (options.live or rotating) and len(options.input) != 1:
        raise ValueError(f"{'--live' if options.live else '--rotating'}: expected one input, got {len(options.input)}")
    if not rotating:
        _refuse(options, "without --rotating or --triggers", ("start_angle",))
    if Path(options.input[0]).is_dir():
        _refuse(options, "a store or a folder", READING_OPTIONS)


def _refuse(options: argparse.Namespace, kind: str, names: Sequence[str]) -> None:
    given = [name for name in names if getattr(options, name) is not None]
    if given:
        raise ValueError(f"{kind}: expected no {_listed(given)}, which does not apply to this input; leave it out")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"--{name.replace('_', '-')}" for name in names)
