"""`polarnet recover`: DoLP and AoLP of recordings or of a running camera."""

import argparse
import functools
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from polarnet.cli.commands import BESIDE
from polarnet.cli.options import CLEANING, READING, cleaning_of, duration_us, given, reading_of, refuse
from polarnet.cli.outputs import WORK, run_folder
from polarnet.cli.project import settings_root
from polarnet.cli.stores import is_store
from polarnet.config.pipeline import setup_of
from polarnet.config.tree import Config, load
from polarnet.events.rotation import Rotation
from polarnet.events.streaming import WindowRule, parse_window
from polarnet.methods import METHODS
from polarnet.methods.method import Method, Setup, why_absent
from polarnet.pictures.images import extension, picture_extensions
from polarnet.recordings.noise import Cleaner
from polarnet.recordings.polarizers import ChannelCheck
from polarnet.recordings.recording import is_recording, open_recording
from polarnet.recordings.repair import HARMLESS
from polarnet.recordings.source import REPAIRS
from polarnet.recovery.inputs import (
    Files,
    half_turn_rule,
    open_files,
    open_frames,
    open_live,
    open_rotating,
    rotation_of,
)
from polarnet.recovery.stream import ChosenMethod, Input, TruthScores, frames_of, open_method, recover
from polarnet.recovery.writer import RecoveryWriter
from polarnet.stokes import POLARIZER_ANGLES_DEG, Mosaic, StokesFrames, parse_mosaic
from polarnet.storage.events import EventStore
from polarnet.storage.true_frames import TrueFrames, open_truth, truth_beside
from polarnet.terminal.suggestions import did_you_mean

WHOLE_METHOD, PAST_METHOD, ROTATING_METHOD = "registered", "ours", "rotating_polarizer"
"""Methods unless --method names one: over a whole recording, from window to window, and with one polarizer."""
RECONSTRUCT = "highpass"
"""Method whose intensities are the S0 of the video."""
NETWORK_WINDOW = "33.333ms"
ARRANGEMENTS = ("angles", "mosaic", "rotating", "triggers", "sequence")
"""Options that say where the polarizers are."""
NOT_LIVE = ("angles", "rotating", "triggers", "sequence", "truth", "frames", "size", "part", *READING)
NOT_ROTATING = (
    "angles", "mosaic", "sequence", "truth", "frames", "method", "weights", "thresholds", "binning", "window",
    *CLEANING,
)  # fmt: skip
"""Options without a meaning for live input, and for one camera behind a rotating polarizer."""
NOT_WITH_FRAMES = ("size", "step")


def run(options: argparse.Namespace) -> None:
    """Recover, write the files and print facts about the input and the result."""
    check_options(options)
    config = load(settings_root(), [f"runtime.device={options.device}"])
    setup = functools.partial(setup_of, config)
    source, rotation, rule = _rotating(options)
    method = options.method or (ROTATING_METHOD if rotation else _network_method(options, setup))
    mosaic = parse_mosaic(options.mosaic) if options.mosaic else None
    frames = _frames_of(options, mosaic)
    settings = options.weights, options.precision, options.thresholds, options.binning, rotation, frames
    recoverer, words = open_method(ChosenMethod(method, *settings), setup)
    truth = _truth_of(options)
    scores = TruthScores(truth) if truth else None
    first = Path(options.input[0])
    name = "live" if options.live else first.stem if first.is_dir() else first.name  # files may differ in suffix alone
    out = options.out or Path("outputs") / "recover" / name
    cleaner = Cleaner(cleaning_of(options), mosaic)
    with run_folder(out, "recover") as folder:
        if options.live:
            print(f"writing frames to {folder}; the folder becomes {out} at the end", file=sys.stderr)
        source = source or _input(options, mosaic, cleaner, folder / WORK, config)
        check, polarized = None, source.channels == len(POLARIZER_ANGLES_DEG)
        if polarized:
            check = ChannelCheck(source.height, source.width, mosaic=mosaic is not None)
            source = source._replace(pieces=check.watch(source.pieces))
        drawn = polarized and "mp4" in options.write and truth is None
        reconstruct = METHODS[RECONSTRUCT].open(setup(METHODS[RECONSTRUCT])) if drawn else None
        writer = RecoveryWriter(folder, options.write, options.video_rate, reconstruct, truth)
        recovered = frames_of(source, rule, recoverer)
        if scores:
            recovered = scores.watch(recovered)
        facts = recover(source, rule, words, writer, recovered)
        if check:
            counts = zip(POLARIZER_ANGLES_DEG, check.counts, strict=True)
            facts["events"] = ", ".join(f"{count:,} at {angle}" for angle, count in counts) + " degrees"
        if scores:
            facts["scores"] = scores.sentence(config.benchmark.warmup_windows)
        if given(options, CLEANING):
            facts["removed"] = cleaner.sentence()
        notes = check.findings() if check else []
        if frames is not None and not len(frames.between(0, writer.stop_us).t_us):
            notes.append(f"none of its {len(frames.t_us)} frames lies within the events: are they on one clock?")
        for name, repairs in source.repairs.items():
            damage = ((kind, count) for kind, count in repairs.items() if count and kind not in HARMLESS)
            notes += [f"{name}: {count:,} {REPAIRS[kind]}." for kind, count in damage]
        page = writer.write_page(source.name, {"command": options.command_line, **facts}, notes)
    for key, value in facts.items():
        print(f"{key:11s} {value}")
    for note in notes:
        print(f"polarnet recover: warning: {note}", file=sys.stderr)
    print(f"page        {out / page.name}")


def _network_method(options: argparse.Namespace, setup_of: Callable[[Method], Setup]) -> str:
    """The network over the whole recording, or from window to window: live, overlapping, or with another network."""
    if options.live or options.step:
        return PAST_METHOD
    whole = METHODS[WHOLE_METHOD]
    other = options.weights and why_absent(whole, replace(setup_of(whole), weights=options.weights))
    return PAST_METHOD if other else WHOLE_METHOD


def _rotating(options: argparse.Namespace) -> tuple[Input | None, Rotation | None, WindowRule]:
    """Input and rotation of one camera behind a rotating polarizer, None for any other input; and the windows."""
    step_us = duration_us(options, "step", "0.1ms")
    if options.rotating is None and options.triggers is None:
        return None, None, WindowRule(*parse_window(options.window or NETWORK_WINDOW), step_us)
    rotation = rotation_of(options.rotating, options.triggers, options.start_angle or 0.0)
    open_file = functools.partial(open_recording, **reading_of(options))
    source, rotation = open_rotating(Path(options.input[0]), rotation, open_file, options.size)
    return source, rotation, half_turn_rule(rotation, step_us)


def _input(options: argparse.Namespace, mosaic: Mosaic | None, cleaner: Cleaner, work: Path, config: Config) -> Input:
    """Cleaned events of live input, or of files with the arrangement that the options state."""
    if options.live:
        return open_live(options.input[0], mosaic, options.idle, cleaner)
    open_file = functools.partial(open_recording, **reading_of(options))
    paths = [Path(path) for path in options.input]
    files = Files(paths, options.angles, mosaic, options.sequence, open_file, config.recordings)
    return open_files(files, work, options.size, cleaner)


def _frames_of(options: argparse.Namespace, mosaic: Mosaic | None) -> StokesFrames | None:
    """The camera's frames of option --frames; ValueError without --mosaic."""
    if not options.frames:
        return None
    if mosaic is None:
        raise ValueError("--frames: expected --mosaic, the polarizers of the camera's pixels")
    return open_frames(Path(options.input[0]), mosaic, functools.partial(open_recording, **reading_of(options)))


def _truth_of(options: argparse.Namespace) -> TrueFrames | None:
    """True frames of option --truth; ValueError if the input is not a store with them."""
    if options.truth is None:
        return None
    path = options.input[0]
    if options.size or not is_store(path):
        raise ValueError("--truth: expected an event store in its own size; leave out --truth or --size")
    truth = truth_beside(path) if options.truth == BESIDE else options.truth
    if truth is None:
        raise ValueError(f"--truth: expected frames.zarr or truth.zarr beside {path}, there is none; name them")
    return open_truth(truth, options.sequence or EventStore.open(path).sequences[0])


def check_options(options: argparse.Namespace) -> None:
    """ValueError for a picture, an unknown method, and options that do not belong together or to the input."""
    first = Path(options.input[0])
    if first.is_file() and extension(first) in picture_extensions():
        raise ValueError(f"{first.name} is a picture, no recording: `polarnet simulate {first}` makes events of it")
    if options.method is not None and options.method not in METHODS:
        near = did_you_mean(options.method, METHODS)
        raise ValueError(f"--method: expected a method of {', '.join(METHODS)}, got {options.method!r}{near}")
    stated = [name for name in ARRANGEMENTS if getattr(options, name) is not None]
    if len(stated) > 1 and stated != ["rotating", "triggers"]:
        raise ValueError(f"expected one arrangement of polarizers, got {given(options, stated)}")
    rotating = "rotating" in stated or "triggers" in stated
    if options.live:
        refuse(options, "--live", NOT_LIVE)
        if options.method == WHOLE_METHOD:
            raise ValueError(f"--live: {WHOLE_METHOD} waits for the whole recording; use --method {PAST_METHOD}")
    if rotating:
        refuse(options, "--rotating", NOT_ROTATING)
    else:
        refuse(options, "without --rotating or --triggers", ["start_angle"])
    if options.frames:
        refuse(options, "--frames", NOT_WITH_FRAMES)
    if (options.live or rotating) and len(options.input) != 1:
        raise ValueError(f"{'--live' if options.live else '--rotating'}: expected one input, got {len(options.input)}")
    if not first.is_dir() or is_recording(first):
        refuse(options, "a recording", ["sequence"])
    elif rotating or options.mosaic is not None:
        refuse(options, "a store", READING)
    else:
        refuse(options, "a store or a folder", ["part", *READING])
