"""The `polarnet` command. A command is a function of a module here, which is imported when the command runs."""

import argparse
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module

from polarnet.cli.commands import command_parser
from polarnet.terminal.environment import (
    INTERRUPTED,
    STOPPED,
    announce_interrupts,
    let_threads_sleep,
    silence_bindings,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    if arguments is None:  # this process is the command
        announce_interrupts()
    let_threads_sleep()
    silence_bindings()
    options = parse(arguments)
    module, _, function = options.run.partition(".")
    try:
        status: int | None = getattr(import_module(f"polarnet.cli.{module}"), function)(options)
    except (ValueError, OSError, RuntimeError, MemoryError) as error:
        print(f"polarnet {options.command}: {error or type(error).__name__}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        warnings.simplefilter("ignore", RuntimeWarning)  # about a call of Zarr that was to start
        print(f"polarnet {options.command}: {STOPPED}", file=sys.stderr)
        return INTERRUPTED
    return status or 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The arguments; words KEY=VALUE behind the options of a command with overrides count as overrides."""
    parser, words = command_parser(), sys.argv[1:] if arguments is None else arguments
    if strange := [word for word in words if any("\ud800" <= character <= "\udfff" for character in word)]:
        parser.error(f"{strange[0]!a}: expected a name in UTF-8; rename the file")
    options, rest = parser.parse_known_args(words)
    if rest and (not hasattr(options, "overrides") or any(w.startswith("-") or "=" not in w for w in rest)):
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if rest:
        options.overrides = [*options.overrides, *rest]
    return options
