"""`polarnet recover` and `recover-rotating`: DoLP and AoLP of recordings or of a running camera."""

import argparse
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from polarnet.cli.options import CLEANING, READING, cleaning_of, duration_us, given, opener_of, refuse
from polarnet.cli.outputs import run_folder
from polarnet.cli.project import settings_root
from polarnet.cli.stores import is_store, truth_of
from polarnet.config.pipeline import setup_of
from polarnet.config.tree import load
from polarnet.events.streaming import TRAINED_WINDOW_US, WindowRule
from polarnet.methods import METHODS, is_rotating
from polarnet.methods.method import Method, Setup, why_absent
from polarnet.pictures.images import extension, picture_extensions
from polarnet.recordings.arrangements import Input
from polarnet.recordings.noise import Cleaner
from polarnet.recordings.polarizers import ChannelCheck
from polarnet.recordings.recording import is_recording
from polarnet.recordings.repair import HARMLESS
from polarnet.recordings.source import REPAIRS
from polarnet.recovery.inputs import open_channels, open_frames, open_live, open_rotating, rotation_of
from polarnet.recovery.stream import TruthScores, frames_of, open_method, recover
from polarnet.recovery.writer import OUTPUTS, RecoveryWriter
from polarnet.runtime.machine import precision_on
from polarnet.stokes import POLARIZER_ANGLES_DEG, Mosaic, StokesFrames, parse_mosaic
from polarnet.storage.events import EventStore
from polarnet.storage.true_frames import TrueFrames
from polarnet.terminal.suggestions import did_you_mean

WHOLE_METHOD, PAST_METHOD = "registered", "ours"
"""Methods unless --method names one: over a whole recording, and from window to window."""
ROTATING_METHOD = "rotating_polarizer"
RECONSTRUCT = "highpass"  # method whose intensities are the S0 of the video
ARRANGEMENTS = ("angles", "mosaic", "sequence")  # options that say where the polarizers are
NOT_LIVE = ("angles", "sequence", "truth", "frames", *READING)  # options without a meaning for live input


def run(options: argparse.Namespace) -> None:
    """Recover, write the files and print facts about the input and the result."""
    check_options(options)
    config = load(settings_root(), [f"runtime.device={options.device}"])
    setup = functools.partial(setup_of, config)
    window_us = duration_us(options, "window", "33.3ms") or TRAINED_WINDOW_US
    rule = WindowRule(window_us, duration_us(options, "step", "0.1ms"))
    method = METHODS[options.method or _network_method(options, setup)]
    mosaic = parse_mosaic(options.mosaic) if options.mosaic else None
    frames = _frames_of(options, mosaic)
    own = setup(method)
    own = replace(own, precision=precision_on(own.device, options.precision), frames=frames)
    settings = {"thresholds": options.thresholds, "binning": options.binning}
    recoverer, words = open_method(method, own, options.weights, settings)
    truth = _truth_of(options)
    scores = TruthScores(truth) if truth else None
    first = Path(options.input[0])
    name = "live" if options.live else first.stem if first.is_dir() else first.name  # files may differ in suffix alone
    out = options.out or Path("outputs") / "recover" / name
    cleaner = Cleaner(cleaning_of(options), mosaic)
    with run_folder(out, "recover") as folder:
        if options.live:
            print(f"writing frames to {folder}; the folder becomes {out} at the end", file=sys.stderr)
        source = _input(options, mosaic, cleaner)
        check = ChannelCheck(source.height, source.width, mosaic=mosaic is not None)
        source = source._replace(pieces=check.watch(source.pieces))
        drawn = "mp4" in options.write and truth is None
        reconstruct = METHODS[RECONSTRUCT].open(setup(METHODS[RECONSTRUCT])) if drawn else None
        writer = RecoveryWriter(folder, options.write, reconstruct, truth)
        recovered = frames_of(source, rule, recoverer)
        if scores:
            recovered = scores.watch(recovered)
        facts = recover(source, rule, words, writer, recovered)
        counts = zip(POLARIZER_ANGLES_DEG, check.counts, strict=True)
        facts["events"] = ", ".join(f"{count:,} at {angle}" for angle, count in counts) + " degrees"
        if scores:
            facts["scores"] = scores.sentence(config.benchmark.warmup_windows)
        if given(options, CLEANING):
            facts["removed"] = cleaner.sentence()
        notes = check.findings()
        if frames is not None and not len(frames.between(0, writer.stop_us).t_us):
            notes.append(f"none of its {len(frames.t_us)} frames lies within the events: are they on one clock?")
        notes += damage(source)
        page = writer.write_page(source.name, {"command": options.command_line, **facts}, notes)
    print_results(facts, notes, out / page.name)


def rotating(options: argparse.Namespace) -> None:
    """Fit every half turn of a rotating polarizer, write the files and print facts about the input and the result."""
    rotation = rotation_of(options.rate, options.triggers, options.start_angle)
    step_us = duration_us(options, "step", "10ms")
    source, rotation = open_rotating(options.input, rotation, opener_of(options))
    rule = WindowRule(step_us or max(1, round(rotation.half_turn_us)), None)
    method = METHODS[ROTATING_METHOD]
    recoverer = method.open(replace(setup_of(load(settings_root()), method), rotation=rotation))
    out = options.out or Path("outputs") / "recover" / options.input.name
    with run_folder(out, "recover-rotating") as folder:
        writer = RecoveryWriter(folder, OUTPUTS)
        words = f"{method.name}, {rotation.rate_hz:g} turns/s"
        facts = recover(source, rule, words, writer, frames_of(source, rule, recoverer))
        notes = damage(source)
        page = writer.write_page(source.name, {"command": options.command_line, **facts}, notes)
    print_results(facts, notes, out / page.name)


def damage(source: Input) -> list[str]:
    """A sentence for each kind of unusable events in each file that was read."""
    kinds = [(name, kind, count) for name, repairs in source.repairs for kind, count in repairs.items()]
    return [f"{name}: {count:,} {REPAIRS[kind]}." for name, kind, count in kinds if count and kind not in HARMLESS]


def print_results(facts: Mapping[str, str], notes: Sequence[str], page: Path) -> None:
    """Print facts, warnings and the place of the page of a recovery."""
    for key, value in facts.items():
        print(f"{key:11s} {value}")
    for note in notes:
        print(f"warning: {note}", file=sys.stderr)
    print(f"page        {page}")


def _network_method(options: argparse.Namespace, setup_of: Callable[[Method], Setup]) -> str:
    """The network over the whole recording, or from window to window: live, or with another network."""
    whole = METHODS[WHOLE_METHOD]
    other = options.weights and why_absent(whole, replace(setup_of(whole), weights=options.weights))
    return PAST_METHOD if options.live or other else WHOLE_METHOD


def _input(options: argparse.Namespace, mosaic: Mosaic | None, cleaner: Cleaner) -> Input:
    """Cleaned events of live input, or of files with the arrangement that the options state."""
    if options.live:
        source = open_live(options.input[0], mosaic, options.idle)
    else:
        open_file = opener_of(options)
        paths = [Path(path) for path in options.input]
        source = open_channels(paths, options.angles, mosaic, options.sequence, open_file)
    return source._replace(pieces=cleaner.clean(source.pieces, live=source.live))


def _frames_of(options: argparse.Namespace, mosaic: Mosaic | None) -> StokesFrames | None:
    """The camera's frames of option --frames; ValueError without --mosaic."""
    if not options.frames:
        return None
    if mosaic is None:
        raise ValueError("--frames: expected --mosaic, the polarizers of the camera's pixels")
    return open_frames(Path(options.input[0]), mosaic, opener_of(options))


def _truth_of(options: argparse.Namespace) -> TrueFrames | None:
    """True frames of option --truth; ValueError if the input is not a store with them."""
    if options.truth is None:
        return None
    path = options.input[0]
    if not is_store(path):
        inside = Path(path) / "events.zarr"  # of a simulation
        advice = f"did you mean {inside}?" if is_store(str(inside)) else "leave out --truth"
        raise ValueError(f"--truth: expected an event store, got {path}; {advice}")
    return truth_of(path, options.sequence or EventStore.open(path).sequences[0], options.truth)


def check_options(options: argparse.Namespace) -> None:
    """ValueError for a picture, an unknown method, and options that do not belong together or to the input."""
    first = Path(options.input[0])
    if first.is_file() and extension(first) in picture_extensions():
        raise ValueError(f"{first.name} is a picture, no recording: `polarnet simulate {first}` makes events of it")
    methods = [name for name in METHODS if not is_rotating(name)]  # polarnet recover-rotating
    if options.method is not None and options.method not in methods:
        near = did_you_mean(options.method, methods)
        raise ValueError(f"--method: expected a method of {', '.join(methods)}, got {options.method!r}{near}")
    stated = [name for name in ARRANGEMENTS if getattr(options, name) is not None]
    if len(stated) > 1:
        raise ValueError(f"expected one arrangement of polarizers, got {given(options, stated)}")
    if options.live:
        refuse(options, "--live", NOT_LIVE)
        if options.method == WHOLE_METHOD:
            raise ValueError(f"--live: {WHOLE_METHOD} waits for the whole recording; use --method {PAST_METHOD}")
    if options.live and len(options.input) != 1:
        raise ValueError(f"--live: expected one input, got {len(options.input)}")
    if not first.is_dir() or is_recording(first):
        refuse(options, "a recording", ["sequence"])
    elif is_store(options.input[0]):
        refuse(options, "an event store", ["angles", "mosaic", *READING])
    else:
        refuse(options, "a folder", READING)
