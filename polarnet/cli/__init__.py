"""The `polarnet` command. Subcommands are thin: each imports the library when it runs and leaves the work to it."""

import argparse
import sys
from collections.abc import Sequence

from polarnet import __version__
from polarnet.cli import benchmark, convert, demo, networks, new, project, recordings, sensors, simulate, stores
from polarnet.terminal.environment import INTERRUPTED, STOPPED, let_threads_sleep, silence_bindings


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    let_threads_sleep()
    silence_bindings()
    options = _options(arguments)
    try:
        return options.run(options)
    except (ValueError, OSError, RuntimeError, MemoryError) as error:
        print(f"polarnet {options.command}: {error or type(error).__name__}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"polarnet {options.command}: {STOPPED}", file=sys.stderr)
        return INTERRUPTED


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The arguments; words KEY=VALUE behind the options of a command with overrides count as overrides."""
    parser, words = _parser(), sys.argv[1:] if arguments is None else arguments
    if strange := [word for word in words if any("\ud800" <= character <= "\udfff" for character in word)]:
        parser.error(f"{strange[0]!a}: expected a name in UTF-8; rename the file")
    options, rest = parser.parse_known_args(words)
    if rest and (not hasattr(options, "overrides") or any(w.startswith("-") or "=" not in w for w in rest)):
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if rest:
        options.overrides = [*options.overrides, *rest]
    return options


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="polarnet",
        description="Degree of linear polarization (DoLP) from event cameras: simulation, training, benchmark and "
        "recovery. `dvc repro` runs the pipeline.",
    )
    parser.add_argument("--version", action="version", version=f"polarnet {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for subject in (demo, project, new, stores, simulate, recordings, convert, sensors, networks, benchmark):
        subject.add_to(commands)
    return parser
