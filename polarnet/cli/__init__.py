"""The `polarnet` command. A command is a function of a module here, which is imported when the command runs."""

import argparse
import shlex
import sys
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
    words = sys.argv[1:] if arguments is None else arguments
    try:
        options = parse(words)
        options.parser.check_inputs(options)
        module, _, function = options.run.partition(".")
        status: int | None = getattr(import_module(f"polarnet.cli.{module}"), function)(options)
    except (ValueError, OSError, RuntimeError, MemoryError) as error:
        print(f"polarnet {words[0]}: {error or type(error).__name__}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"polarnet {words[0]}: {STOPPED}", file=sys.stderr)
        return INTERRUPTED
    return status or 0


def parse(words: Sequence[str]) -> argparse.Namespace:
    """The arguments; words KEY=VALUE behind the options of a command with overrides count as overrides.

    `command_line` of the result is the whole command, as typed in a shell.
    """
    parser = command_parser()
    if strange := [word for word in words if any("\ud800" <= character <= "\udfff" for character in word)]:
        parser.error(f"{strange[0]!a}: expected a name in UTF-8; rename the file")
    options, rest = parser.parse_known_args(words)
    if rest and (not hasattr(options, "overrides") or any(w.startswith("-") or "=" not in w for w in rest)):
        options.parser.refuse(rest)
    if rest:
        options.overrides = [*options.overrides, *rest]
    options.command_line = shlex.join(["polarnet", *words])
    return options
