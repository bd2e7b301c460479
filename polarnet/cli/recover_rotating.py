"""`polarnet recover-rotating`: DoLP and AoLP from the events of one camera behind a rotating polarizer."""

import argparse
import functools
from dataclasses import replace
from pathlib import Path

from polarnet.cli.options import duration_us, reading_of
from polarnet.cli.outputs import run_folder
from polarnet.cli.project import settings_root
from polarnet.cli.recover import damage, print_results
from polarnet.config.pipeline import setup_of
from polarnet.config.tree import load
from polarnet.events.streaming import WindowRule
from polarnet.methods import METHODS
from polarnet.recordings.recording import open_recording
from polarnet.recovery.inputs import open_rotating, rotation_of
from polarnet.recovery.stream import frames_of, recover
from polarnet.recovery.writer import OUTPUTS, RecoveryWriter

METHOD = METHODS["rotating_polarizer"]


def run(options: argparse.Namespace) -> None:
    """Fit every half turn, write the files and print facts about the input and the result."""
    rotation = rotation_of(options.rate, options.triggers, options.start_angle)
    step_us = duration_us(options, "step", "10ms")
    source, rotation = open_rotating(options.input, rotation, functools.partial(open_recording, **reading_of(options)))
    rule = WindowRule(step_us or max(1, round(rotation.half_turn_us)), None)
    recoverer = METHOD.open(replace(setup_of(load(settings_root()), METHOD), rotation=rotation))
    out = options.out or Path("outputs") / "recover" / options.input.name
    with run_folder(out, "recover-rotating") as folder:
        writer = RecoveryWriter(folder, OUTPUTS)
        words = f"{METHOD.name}, {rotation.rate_hz:g} turns/s"
        facts = recover(source, rule, words, writer, frames_of(source, rule, recoverer))
        notes = damage(source)
        page = writer.write_page(source.name, {"command": options.command_line, **facts}, notes)
    print_results(facts, notes, out / page.name)
